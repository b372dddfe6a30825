"""Processes are killed or frozen at random moments and jobs cancelled: no job is lost, every matte is the same to
the byte.
"""

import random
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from storage.objects.store import Objects
from tests.conftest import EXHAUSTIVE
from tests.end_to_end.conftest import serving
from tests.faults.conftest import Prepared, check
from tests.parts.background import repeating
from tests.parts.processes import alive
from tests.parts.rig import Row, freeze, stored, thaw
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(7200)


@pytest.mark.exhaustive  # the slow test that kills any process of a service kills workers, too
def test_killed_worker(prepared: Prepared, table: list[Row], times: int) -> None:
    def kill() -> None:
        until(prepared.rig.workers)
        random.choice(prepared.rig.workers()).kill()

    check(table, prepared.disturb("SIGKILL of a worker", kill, times))


@pytest.mark.exhaustive
def test_all_workers_killed(prepared: Prepared, table: list[Row], times: int) -> None:
    def kill() -> None:
        for worker in prepared.rig.workers():
            worker.kill()

    check(table, prepared.disturb("SIGKILL of all workers", kill, times))


@pytest.mark.exhaustive
def test_killed_scheduler(prepared: Prepared, table: list[Row], times: int) -> None:
    rig = prepared.rig
    row = prepared.disturb("SIGKILL of the scheduler", lambda: rig.restart("scheduler"), times)
    check(table, row)


@pytest.mark.slow
def test_killed_leading_service(prepared: Prepared, table: list[Row], times: int) -> None:
    rig = prepared.rig
    row = prepared.disturb("SIGKILL of API and coordinator", lambda: rig.restart(rig.leader()), times)
    check(table, row)


@pytest.mark.exhaustive
def test_frozen_worker(prepared: Prepared, table: list[Row]) -> None:
    frozen: list[psutil.Process] = []

    def act() -> None:
        frozen.append(prepared.rig.workers()[0])
        freeze(frozen[0])

    start = time.monotonic()
    row = prepared.disturb("SIGSTOP of a worker, for 60 s", act, 1)
    time.sleep(max(0.0, 60 - (time.monotonic() - start)))
    with suppress(psutil.NoSuchProcess):  # its nanny may have killed it meanwhile
        thaw(frozen[0])
    time.sleep(3)  # time to do what it was about to do when frozen
    (matte, *_) = prepared.rig.ask("GET", "/v1/mattes").json()["mattes"]
    assert prepared.rig.files(matte["id"]) == prepared.files
    check(table, row)


@pytest.mark.slow
def test_cancelled_job_frees_workers_and_disk(prepared: Prepared) -> None:
    rig = prepared.rig
    # One tile of nn-dgsr that takes minutes.
    options = {"method": "nn-dgsr", "tile": 1024}
    job = rig.ask("POST", "/v1/jobs", json={"capture": prepared.capture, "options": options}).json()
    until(lambda: rig.job(job["id"])["stage"] == "recovering")
    time.sleep(1)
    cancelled = rig.ask("POST", f"/v1/jobs/{job['id']}/cancel").json()
    assert cancelled["state"] == "cancelled"
    until(lambda: not rig.names(job["matte"]), 10)
    assert rig.ask("GET", f"/v1/mattes/{job['matte']}").status_code == 404
    after = rig.recover(prepared.capture)
    prepared.check_continues(after["id"], after["matte"])
    assert not rig.names(job["matte"])


PROMISED = 10.0
"""Seconds until a process that was killed is there again; decoders and their servers start when next needed."""


@dataclass
class Watch:
    """Kills processes below a service at random, and sees when there is another in their role."""

    service: psutil.Process
    usual: Counter[str] = field(default_factory=Counter)
    """How many there are in each role."""
    seen: set[psutil.Process] = field(default_factory=set)
    killed: list[tuple[psutil.Process, str, float]] = field(default_factory=list)
    """Those that nothing has replaced yet, their roles, and when they were killed."""
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def look(self) -> Counter[str]:
        """Count the processes in each role."""
        roles = {}
        for process in self.service.children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if process.status() != psutil.STATUS_ZOMBIE:
                    roles[process] = role_of(process)
        self.seen |= roles.keys()
        found = Counter(roles.values())
        for process, role, at in self.killed.copy():
            if process not in roles and found[role] >= self.usual[role]:
                self.killed.remove((process, role, at))
                self.seconds.setdefault(role, []).append(time.monotonic() - at)
        return found

    def kill_one(self) -> None:
        process = random.choice(self.service.children(recursive=True))
        role = role_of(process)
        process.kill()
        self.killed.append((process, role, time.monotonic()))


def role_of(process: psutil.Process) -> str:
    """What a process of a service is for, by its command; those that are forked have that of their server."""
    command = " ".join(process.cmdline())
    forked = " ".join(psutil.Process(process.ppid()).cmdline()) == command
    for module, server, child in (
        ("multiprocessing.forkserver", "fork server", "worker"),
        ("decoder_server", "server of decoders", "decoder"),
    ):
        if module in command:
            return child if forked else server
    return "resource tracker"


@pytest.mark.slow
def test_any_process_of_a_service_killed(
    capture_archive: Path, tmp_path: Path, table: list[Row], times: int
) -> None:
    row = Row("SIGKILL of any process, 4 a job")
    replaced_soon = {"worker", "fork server", "resource tracker"}
    with serving(tmp_path / "data", "--workers", "2") as service:
        watch = Watch(psutil.Process(service.process.pid))
        capture = service.client.upload(capture_archive)["id"]
        objects = Objects((tmp_path / "data" / "store").as_uri())

        def recovered(kills: int) -> dict[str, str]:
            job = service.client.recover(capture, tile=16)
            for _ in range(kills):
                time.sleep(random.uniform(0.5, 2))
                with suppress(psutil.NoSuchProcess, IndexError):  # it ended, or all of them have
                    watch.kill_one()
                    row.injected += 1
            began = time.monotonic()
            until(lambda: service.client.job(job["id"])["state"] not in ("queued", "running"), 120)
            row.seconds.append(time.monotonic() - began)
            row.lost += service.client.job(job["id"])["state"] != "succeeded"
            return stored(objects, f"mattes/{job['matte']}")

        expected = recovered(0)
        row.seconds.clear()
        watch.usual = watch.look()
        with repeating(watch.look, 0.1):
            for _ in range(times):
                row.differing += recovered(4) != expected
            until(lambda: not replaced_soon & {role for _, role, _ in watch.killed}, 60)
    for role, seconds in watch.seconds.items():
        print(f"\n{role}: {len(seconds)} killed, another after {max(seconds):.1f} s at most")
    print(f"\nnot needed since: {Counter(role for _, role, _ in watch.killed)}")
    if times >= EXHAUSTIVE:  # a short run may not have the machine to itself
        assert max(max(watch.seconds.get(role, [0])) for role in replaced_soon) < PROMISED
    until(lambda: not alive(list(watch.seen)), 30)
    assert not list((tmp_path / "data" / "scratch").glob("**/worker-*/"))
    assert objects.names("uploads") == []
    check(table, row)
