"""The image, and the cluster of compose.yaml; needs a Docker engine, and `docker compose` or `docker-compose`."""

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

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

FOLDER = Path(__file__).parents[2] / "docker"
KEY = "a-key-of-the-test"


def run(*command: str, **environment: str) -> str:
    """Run a command and return what it prints; if it fails, the test fails with its output."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=1500, env=os.environ | environment, check=False
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout.strip()


def compose_command() -> list[str]:
    """The command for compose, `docker compose` or `docker-compose`; skips the test if there is none, or no engine."""
    if shutil.which("docker") is None:
        pytest.skip("docker is not installed")
    if subprocess.run(["docker", "info"], capture_output=True, timeout=60).returncode:
        pytest.skip("no Docker engine answers")
    for command in (["docker", "compose"], ["docker-compose"]):
        if (
            shutil.which(command[0])
            and not subprocess.run([*command, "version"], capture_output=True).returncode
        ):
            return command
    pytest.skip("docker compose is not installed")


@dataclass
class Cluster:
    """The cluster of compose.yaml, with SQLite and a folder."""

    command: list[str]
    environment: dict[str, str]
    project: str
    url: str = ""

    def compose(self, *arguments: str) -> str:
        files = ["-f", str(FOLDER / "compose.yaml"), "-f", str(FOLDER / "compose.local.yaml")]
        return run(*self.command, *files, "-p", self.project, *arguments, **self.environment)

    def containers(self, service: str = "", everything: bool = False) -> list[str]:
        """Ids of the running containers, or of stopped ones too."""
        label = f"label=com.docker.compose.project={self.project}"
        ours = ["--filter", f"label=com.docker.compose.service={service}"] if service else []
        return run("docker", "ps", "-q", *(["-a"] if everything else []), "--filter", label, *ours).split()


def inspect(container: str, template: str) -> str:
    return run("docker", "inspect", "--format", template, container)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """The cluster with two workers; afterwards only the layers of the image remain, for the next build."""
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


def test_containers_run_unprivileged_and_read_only(cluster: Cluster, client: Client) -> None:
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


def test_only_the_api_is_published(cluster: Cluster, client: Client) -> None:
    published = [run("docker", "port", container) for container in cluster.containers()]
    assert sorted(published) == [*[""] * 4, f"8000/tcp -> {cluster.url.removeprefix('http://')}"]
    assert cluster.url.startswith("http://127.0.0.1:")


def test_api_and_scheduler_become_healthy(cluster: Cluster, client: Client) -> None:
    for name in ("api", "scheduler"):
        (container,) = cluster.containers(name)
        until(lambda id=container: inspect(id, "{{.State.Health.Status}}") == "healthy")


def test_request_without_a_key_is_refused(cluster: Cluster, client: Client) -> None:
    assert httpx2.get(f"{cluster.url}/v1/captures").status_code == 401


def test_job_survives_the_death_of_workers_and_coordinator(
    cluster: Cluster, client: Client, capture: str
) -> None:
    undisturbed = client.wait(client.recover(capture, tile=16)["id"])
    job = client.recover(capture, tile=16)["id"]
    until(lambda: client.job(job)["tiles"]["done"] >= 2)
    killed, crashed = cluster.containers("worker")
    run("docker", "kill", killed)
    (coordinator,) = cluster.containers("coordinator")
    for container in (crashed, coordinator):
        # Kill the process below init, as if it had crashed: docker does not restart a container that it killed itself.
        kill = "import os; os.kill(int(open('/proc/1/task/1/children').read().split()[0]), 9)"
        run("docker", "exec", container, "python", "-c", kill)
    assert client.job(job)["state"] == "running"
    ended = client.wait(job)
    assert ended["tiles"] == undisturbed["tiles"]
    assert composite(client, ended["matte"]) == composite(client, undisturbed["matte"])
    assert cluster.containers("worker") == [crashed]
    assert [inspect(id, "{{.RestartCount}}") for id in (crashed, coordinator)] == ["1", "1"]


def test_stopped_containers_exit_with_0(cluster: Cluster, client: Client) -> None:
    containers = cluster.containers()
    run("docker", "stop", "-t", "60", *containers)
    assert [inspect(id, "{{.State.ExitCode}}") for id in containers] == ["0"] * len(containers)
