"""Workers as jobs of SLURM, started by docker/slurm.sh; needs the daemons of SLURM, and root to run them."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from services.client import Client
from services.runtime.certificates import make
from tests.end_to_end.conftest import Service, digests, serving
from tests.parts.waiting import until
from tests.services.cluster.clusters import address, started
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

SCRIPT = Path(__file__).parents[2] / "docker" / "slurm.sh"
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
SlurmdUser=root
AuthInfo=socket={folder}/munge/socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
KillWait=15
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=8000
PartitionName=all Nodes=ALL Default=YES State=UP
"""


@dataclass
class Slurm:
    """A SLURM of one machine, configured with four cores."""

    environment: dict[str, str]

    def __call__(self, *command: str, **environment: str) -> str:
        """Run a command of SLURM and return what it prints."""
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60, env=self.environment | environment
        )
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
        return done.stdout.strip()

    def state(self, job: str) -> str:
        return self("squeue", "--noheader", "--states=all", "--format=%T", "--jobs", job)

    def submit(self, *options: str) -> str:
        return self("sbatch", "--parsable", "--mem-per-cpu=900", *options, str(SCRIPT))


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    """SLURM with its files in a temporary folder and its daemons as child processes."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"there is no {', '.join(missing)}: install slurmctld, slurmd, slurm-client and munge")
    if os.getuid():
        pytest.skip("the daemons of SLURM run jobs as other users: they must run as root")
    folder, host = tmp_path_factory.mktemp("slurm"), socket.gethostname().partition(".")[0]
    for name in ("munge", "state", "spool", "tmp"):
        (folder / name).mkdir()
    (folder / "key").write_bytes(os.urandom(1024))
    (folder / "key").chmod(0o600)
    with ExitStack() as stack:
        taken = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        ports = [one.getsockname()[1] for one in taken]
    configuration = folder / "slurm.conf"
    configuration.write_text(CONFIGURATION.format(host=host, ports=ports, folder=folder))
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {
        "SLURM_CONF": str(configuration),
        "PATH": path,
        "TMPDIR": str(folder / "tmp"),
    }
    running = Slurm(environment)
    munge = [f"--{name}={folder}/munge/{name}" for name in ("socket", "pid-file", "log-file", "seed-file")]
    with ExitStack() as stack:
        for command in (
            ["munged", "--foreground", "--force", f"--key-file={folder}/key", *munge],
            ["slurmctld", "-D", "-c"],
            ["slurmd", "-D", "-N", host],
        ):
            log = stack.enter_context((folder / f"{command[0]}.log").open("wb"))
            process = subprocess.Popen(
                command, stdout=log, stderr=log, env=environment, start_new_session=True
            )
            stack.callback(process.wait, 60)
            stack.callback(process.terminate)
            if command[0] == "munged":
                until((folder / "munge" / "socket").exists)
        until(lambda: "idle" in running("sinfo", "--noheader", "--format=%t"))
        try:
            yield running
        finally:
            running("scancel", "--user=root")
            until(lambda: running("squeue", "--noheader") == "")


@pytest.fixture(scope="module")
def service(slurm: Slurm, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose scheduler waits for workers; `slurm.environment` gets the variables for `sbatch`."""
    folder = tmp_path_factory.mktemp("cluster")
    certs = folder / "certs"
    make(certs)
    with started(folder / "scheduler.log", "scheduler", "--port", "0", "--certs", str(certs)) as scheduler:
        where = {"ENVMATTE_CLUSTER": address(scheduler), "ENVMATTE_CERTS": str(certs)}
        slurm.environment |= where | {"SBATCH_OUTPUT": str(folder / "%x-%A-%a.log")}
        with serving(folder / "data", **where) as running:
            yield running


def workers(service: Service) -> list[dict[str, float]]:
    found: list[dict[str, float]] = service.http.get("/v1/cluster").json()["workers"]
    return found


def recovered(client: Client, capture: str) -> dict[str, object]:
    return client.wait(client.recover(capture, tile=16)["id"])


def test_job_survives_cancelled_workers(slurm: Slurm, service: Service, tmp_path: Path) -> None:
    array = slurm.submit("--array=1-2", "--cpus-per-task=1")
    until(lambda: len(workers(service)) == 2)
    assert {one["memory_limit_bytes"] for one in workers(service)} == {900_000_000}
    path = tmp_path / "ball.zip"
    write_capture(glass_ball.glass_ball(96, 72, rays=16), preset("quick"), path, name="ball")
    capture = service.client.upload(path)
    service.client.wait(capture["job"])
    undisturbed = recovered(service.client, capture["id"])
    job = service.client.recover(capture["id"], tile=16)
    until(lambda: service.client.job(job["id"])["tiles"]["done"] >= 2)
    slurm("scancel", f"{array}_1")
    assert service.client.job(job["id"])["state"] == "running"
    ended = service.client.wait(job["id"])
    until(lambda: slurm.state(f"{array}_1") == "CANCELLED")
    assert slurm.state(f"{array}_2") == "RUNNING"
    mattes = service.data / "store" / "mattes"
    assert digests(mattes / str(ended["matte"])) == digests(mattes / str(undisturbed["matte"]))
    slurm("scancel", array)
    until(lambda: slurm.state(f"{array}_2") == "CANCELLED")
    assert list(Path(slurm.environment["TMPDIR"]).iterdir()) == []


def test_workers_are_requeued_at_their_time_limit(slurm: Slurm, service: Service) -> None:
    job = slurm.submit("--array=1", "--cpus-per-task=2")
    until(lambda: len(workers(service)) == 2)
    slurm("scancel", "--batch", "--signal=USR1", f"{job}_1")  # as SLURM does at the time limit
    until(lambda: slurm.state(f"{job}_1") == "PENDING")
    shown = slurm("scontrol", "show", "job", f"{job}_1").split()
    assert {"Requeue=1", "Restarts=1"} <= set(shown)
    assert list(Path(slurm.environment["TMPDIR"]).iterdir()) == []


def test_script_without_a_cluster_names_the_missing_variable(slurm: Slurm, tmp_path: Path) -> None:
    log = tmp_path / "log"
    bare = {"ENVMATTE_CLUSTER": "", "ENVMATTE_CERTS": "", "SBATCH_OUTPUT": str(log)}
    job = slurm("sbatch", "--parsable", "--mem-per-cpu=100", "--cpus-per-task=1", str(SCRIPT), **bare)
    until(lambda: slurm.state(job) == "FAILED")
    assert "ENVMATTE_CLUSTER: name the scheduler" in log.read_text()
