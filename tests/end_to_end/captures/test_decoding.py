"""Decoders that hang, die or take too much memory affect only the request or job they work for."""

import json
import re
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from pathlib import Path

import httpx2
import psutil
import pytest

from services.client import ServiceError
from services.decoding.pool import SECONDS
from tests.end_to_end.conftest import Service, serving
from tests.end_to_end.mattes.test_composites import SENT, post_composite
from tests.end_to_end.problems import check_problem
from tests.parts.processes import alive
from tests.parts.waiting import until
from tests.services.api.mattes.archives import archive
from tests.services.cluster.clusters import children, decoders, workers
from tests.workflows.composite.video.test_steps import clip, even, pictures
from tests.workflows.ingest.video.camera import capture as filmed
from tests.workflows.ingest.video.camera import fragmented, overstated, zipped
from workflows.programs.program import Program
from workflows.untrusted import confinement

pytestmark = pytest.mark.slow

ZIP = {"Content-Type": "application/zip"}


@contextmanager
def held(service: Service, matte: str) -> Iterator[tuple[psutil.Process, "Future[httpx2.Response]"]]:
    """Stop a decoder in the middle of a request; yields both. The next request gets another decoder."""
    idle = decoders(service.process)
    for one in idle:
        one.kill()
    until(lambda: not alive(idle))  # its memory goes first, its sockets last
    assert post_composite(service, matte).status_code == 200
    (one,) = decoders(service.process)
    one.suspend()
    with ThreadPoolExecutor(2) as threads, httpx2.Client(base_url=service.url, timeout=4 * SECONDS) as http:
        url = f"/v1/mattes/{matte}/composite"
        both = [threads.submit(http.post, url, content=SENT) for _ in range(2)]
        done, (left,) = wait_for(both, return_when=FIRST_COMPLETED)
        assert [answer.result().status_code for answer in done] == [200]
        yield one, left


def test_killed_decoder_costs_one_request(service: Service, matte: str) -> None:
    expected = post_composite(service, matte).content
    with held(service, matte) as (one, answer):
        one.kill()
        problem = check_problem(answer.result(), 422, "bad-image")
    assert "SIGKILL" in problem["detail"]
    assert post_composite(service, matte).content == expected


def test_hanging_decoder_is_killed_and_others_keep_serving(service: Service, matte: str) -> None:
    expected = post_composite(service, matte).content
    with held(service, matte) as (one, answer):
        meanwhile = 0
        while not answer.done():
            assert post_composite(service, matte).content == expected
            assert service.http.get("/healthz").status_code == 200
            meanwhile += 1
        problem = check_problem(answer.result(), 422, "bad-image")
        assert meanwhile > 3
        assert "takes more than 20 s" in problem["detail"]
        until(lambda: not alive([one]))


@pytest.mark.parametrize(
    ("end", "environment"),
    [("terminate", {}), ("kill", {}), ("kill", {"ENVMATTE_COORDINATE": "false"})],
    ids=["terminated", "killed", "killed without workers"],
)
def test_decoders_end_with_the_service(tmp_path: Path, end: str, environment: dict[str, str]) -> None:
    with serving(tmp_path / "data", "--workers", "1", **environment) as service:
        sent = service.http.post("/v1/mattes", content=archive(tmp_path, 40, 30), headers=ZIP)
        matte = sent.json()["id"]
        assert post_composite(service, matte).status_code == 200
        assert decoders(service.process)
        tree = children(service.process)
        getattr(service.process, end)()
        service.process.wait(120)
        until(lambda: not alive(tree))


def peak_memory(one: psutil.Process) -> int:
    """Peak of a process's resident memory, in bytes."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{one.pid}/status").read_text())
    assert found is not None
    return int(found[1]) << 10


@pytest.mark.exhaustive
@pytest.mark.skipif(sys.platform != "linux", reason="it is Linux that limits what a process takes")
def test_film_that_needs_too_much_memory_fails_only_its_job(
    capture_archive: Path, program: Program, tmp_path: Path
) -> None:
    data = overstated(clip(pictures(9), even(9)), 40_000_000)  # FFmpeg would build an index of 2.8 GB
    manifest, files = filmed(program, data, 2.0)
    bomb = tmp_path / "bomb.zip"
    bomb.write_bytes(zipped(json.dumps(manifest).encode(), files))
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_INGEST_MEMORY=str(64 << 20)) as service:
        sent = service.http.post("/v1/mattes", content=archive(tmp_path, 40, 30), headers=ZIP)
        matte = sent.json()["id"]
        service.client.wait(service.client.upload(capture_archive)["job"])
        (worker,) = workers(service.process)
        before = peak_memory(worker)

        uploaded = service.client.upload(bomb)
        with pytest.raises(ServiceError, match="an index that takes too much memory") as caught:
            service.client.wait(uploaded["job"])
        assert caught.value.problem["entry"] == "clip.mp4"
        # This one allocates in small steps, and not every process can unpickle FFmpeg's own error.
        slowly = zipped(json.dumps(manifest).encode(), {"clip.mp4": fragmented(4_000_000)})
        job = service.http.post("/v1/captures", content=slowly, headers=ZIP).json()["job"]
        # If its last step fails, FFmpeg reports damage instead.
        with pytest.raises(ServiceError, match=r"takes (more than the 384 MB|too much memory)"):
            service.client.wait(job)
        job = service.http.post(
            f"/v1/mattes/{matte}/composite", content=data, headers={"Content-Type": "video/mp4"}
        ).json()["id"]
        with pytest.raises(ServiceError, match="an index that takes too much memory"):
            service.client.wait(job)

        assert workers(service.process) == [worker]
        assert peak_memory(worker) - before < 500 << 20
        service.client.wait(service.client.upload(capture_archive)["job"])


WITHOUT_LANDLOCK = """
import ctypes, os, struct, sys
# All calls are allowed but landlock_create_ruleset, as by the profile of a container.
lines = [(0x20, 0, 0, 0), (0x15, 0, 1, 444), (6, 0, 0, 0x00050001), (6, 0, 0, 0x7FFF0000)]
code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in lines))
libc = ctypes.CDLL(None)
assert libc.prctl(38, 1, 0, 0, 0) == 0
assert libc.prctl(22, 2, struct.pack("@HP", len(lines), ctypes.addressof(code)), 0, 0) == 0
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""


@pytest.mark.skipif(confinement.missing() is not None, reason=str(confinement.missing()))
def test_machine_that_cannot_confine_decoders_is_named(capture_archive: Path, tmp_path: Path) -> None:
    log = tmp_path / "data.log"
    within = [sys.executable, "-c", WITHOUT_LANDLOCK]
    with serving(tmp_path / "data", "--workers", "1", within=within) as service:
        service.client.wait(service.client.upload(capture_archive)["job"])
        found = service.http.get("/v1/cluster").json()
        (worker,) = found["workers"]
        for said in (found["unconfined_decoders"], worker["unconfined_decoders"]):
            assert "lacks Landlock" in said
            assert "seccomp" not in said
    assert log.read_text().count("lacks Landlock") >= 2
