"""The image, and the cluster that compose.yaml makes of it; needs a Docker engine, and compose of either kind."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import httpx2
import numpy as np
import pytest

from services.client import Client
from tests.parts.waiting import until
from workflows.images import integer_formats
from workflows.images.tone_curves import from_light
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

FOLDER = Path(__file__).parents[2] / "docker"
KEY = "a-key-of-the-test"


def run(*command: str, **environment: str) -> str:
    """What a command prints; the test fails with what it says if it fails."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=600, env=os.environ | environment, check=False
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout.strip()


def compose_command() -> list[str]:
    """How compose is called here, `docker compose` or `docker-compose`; the test is skipped if nothing can be run."""
    if shutil.which("docker") is None:
        pytest.skip("there is no docker command")
    if subprocess.run(["docker", "info"], capture_output=True, timeout=60).returncode:
        pytest.skip("no Docker engine answers")
    for command in (["docker", "compose"], ["docker-compose"]):
        if (
            shutil.which(command[0])
            and not subprocess.run([*command, "version"], capture_output=True).returncode
        ):
            return command
    pytest.skip("there is no docker compose")


@dataclass
class Cluster:
    """What compose.yaml makes, with SQLite and a folder."""

    command: list[str]
    environment: dict[str, str]
    project: str
    url: str = ""

    def compose(self, *arguments: str) -> str:
        files = ["-f", str(FOLDER / "compose.yaml"), "-f", str(FOLDER / "compose.local.yaml")]
        return run(*self.command, *files, "-p", self.project, *arguments, **self.environment)

    def containers(self, service: str = "", everything: bool = False) -> list[str]:
        """Ids of those that run, or of everything there ever was."""
        label = f"label=com.docker.compose.project={self.project}"
        ours = ["--filter", f"label=com.docker.compose.service={service}"] if service else []
        return run("docker", "ps", "-q", *(["-a"] if everything else []), "--filter", label, *ours).split()


def inspected(container: str, what: str) -> str:
    return run("docker", "inspect", "--format", what, container)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """The cluster with two workers; nothing of it is left but the layers of the image, for the next build."""
    name = f"envmatte-test-{uuid4().hex[:8]}"
    environment = {
        "ENVMATTE_IMAGE": name,
        "ENVMATTE_KEYS": KEY,
        "ENVMATTE_LISTEN": "127.0.0.1:0",
        "POSTGRES_PASSWORD": "unused",
        "AWS_SECRET_ACCESS_KEY": "unused",
    }
    made = Cluster(compose_command(), environment, name)
    made.compose("build")
    try:
        made.compose("up", "-d", "--scale", "worker=2")
        made.url = "http://" + made.compose("port", "api", "8000")
        yield made
    finally:
        made.compose("down", "--volumes", "--remove-orphans")
        run("docker", "image", "rm", name)
        assert made.containers(everything=True) == []
        assert run("docker", "volume", "ls", "-q", "--filter", f"name={name}") == ""


@pytest.fixture(scope="module")
def client(cluster: Cluster) -> Iterator[Client]:
    """A client of the cluster, as soon as it is ready."""

    def ready() -> bool:
        try:
            return httpx2.get(f"{cluster.url}/readyz").status_code == 200
        except httpx2.TransportError:
            return False

    until(ready)
    with Client(cluster.url, KEY) as client:
        yield client


@pytest.fixture(scope="module")
def capture(client: Client, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A capture in the cluster, ingested."""
    path = tmp_path_factory.mktemp("capture") / "ball.zip"
    write_capture(glass_ball.glass_ball(96, 72, rays=16), preset("quick"), path, name="ball")
    uploaded = client.upload(path)
    client.wait(uploaded["job"])
    return str(uploaded["id"])


def composite(client: Client, matte: str) -> bytes:
    backdrop = integer_formats.to_integers(from_light(glass_ball.backdrop(), "srgb"), np.dtype(np.uint8))
    return client.composite(matte, integer_formats.encode_png(backdrop))


def test_every_process_has_no_more_rights_than_it_needs(cluster: Cluster, client: Client) -> None:
    containers = cluster.containers()
    assert len(containers) == 5  # the API, the coordinator, the scheduler, two workers
    for container in containers:
        inside = ["docker", "exec", container]
        user = "print(open('/proc/1/status').read().split('Uid:')[1].split()[0])"
        assert run(*inside, "python", "-c", user) == "10001"
        refused = subprocess.run([*inside, "touch", "/etc/x"], capture_output=True, text=True)
        assert "Read-only file system" in refused.stderr
        assert subprocess.run([*inside, "python", "-c", "import pip"], capture_output=True).returncode == 1
        rights = run(*inside, "stat", "-c", "%a %u", "/certs", "/certs/key.pem")
        assert rights.splitlines() == ["700 10001", "600 10001"]


def test_nothing_but_the_api_is_published(cluster: Cluster, client: Client) -> None:
    published = [run("docker", "port", container) for container in cluster.containers()]
    assert sorted(published) == [*[""] * 4, f"8000/tcp -> {cluster.url.removeprefix('http://')}"]
    assert cluster.url.startswith("http://127.0.0.1:")


def test_those_that_can_tell_are_healthy(cluster: Cluster, client: Client) -> None:
    for name in ("api", "scheduler"):
        (container,) = cluster.containers(name)
        until(lambda id=container: inspected(id, "{{.State.Health.Status}}") == "healthy")


def test_nobody_without_a_key_gets_in(cluster: Cluster, client: Client) -> None:
    assert httpx2.get(f"{cluster.url}/v1/captures").status_code == 401


def test_a_job_outlives_what_works_on_it(cluster: Cluster, client: Client, capture: str) -> None:
    undisturbed = client.wait(client.recover(capture, tile=16)["id"])
    job = client.recover(capture, tile=16)["id"]
    until(lambda: client.job(job)["tiles"]["done"] >= 2)
    killed, crashed = cluster.containers("worker")
    run("docker", "kill", killed)
    (coordinator,) = cluster.containers("coordinator")
    for container in (crashed, coordinator):
        # The process below init, as if it had died by itself: docker takes what it killed itself for unwanted.
        kill = "import os; os.kill(int(open('/proc/1/task/1/children').read().split()[0]), 9)"
        run("docker", "exec", container, "python", "-c", kill)
    assert client.job(job)["state"] == "running"
    ended = client.wait(job)
    assert ended["tiles"] == undisturbed["tiles"]
    assert composite(client, ended["matte"]) == composite(client, undisturbed["matte"])
    assert cluster.containers("worker") == [crashed]
    assert [inspected(id, "{{.RestartCount}}") for id in (crashed, coordinator)] == ["1", "1"]


def test_all_of_them_end_when_asked(cluster: Cluster, client: Client) -> None:
    containers = cluster.containers()
    run("docker", "stop", "-t", "60", *containers)
    assert [inspected(id, "{{.State.ExitCode}}") for id in containers] == ["0"] * len(containers)
