"""An ingest that needs more memory than its worker has fails with a remedy and disturbs no other job."""

import json
import time
import zipfile
from pathlib import Path

import imagecodecs
import pytest

from tests.end_to_end.conftest import digests, serving
from tests.faults.conftest import check
from tests.parts.rig import Row
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(1800)

LARGER = 14
"""Factor by which frames are enlarged."""
LIMIT = 460 << 20
"""Memory limit of a worker in bytes: enough for small captures."""
TOO_MUCH, ENOUGH = 4 << 30, 64 << 20
"""Memory setting of the ingest in bytes: larger and smaller than what its worker has."""


@pytest.fixture(scope="module")
def large(capture_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with frames of 3 megapixels, all in one slab if memory allows."""
    path = tmp_path_factory.mktemp("large") / "large.zip"
    with zipfile.ZipFile(capture_archive) as source, zipfile.ZipFile(path, "w") as target:
        manifest = json.loads(source.read("capture.json"))
        target.writestr("capture.json", json.dumps(manifest))
        for frame in manifest["frames"]:
            pixels = imagecodecs.png_decode(source.read(frame["file"]))
            pixels = pixels.repeat(LARGER, 0).repeat(LARGER, 1)
            target.writestr(frame["file"], imagecodecs.png_encode(pixels, level=1))
    return path


@pytest.mark.exhaustive
def test_worker_out_of_memory(capture_archive: Path, large: Path, tmp_path: Path, table: list[Row]) -> None:
    memory = {"ENVMATTE_WORKER_MEMORY": str(LIMIT)}
    with serving(
        tmp_path / "data", "--workers", "2", **memory, ENVMATTE_INGEST_MEMORY=str(TOO_MUCH)
    ) as service:
        capture = service.client.upload(capture_archive)
        service.client.wait(capture["job"])
        undisturbed = service.client.wait(service.client.recover(capture["id"])["id"])["matte"]
        uploaded, start = service.client.upload(large), time.monotonic()
        until(lambda: service.client.job(uploaded["job"])["stage"] == "reading")
        other = service.client.recover(capture["id"])
        until(lambda: service.client.job(uploaded["job"])["state"] not in ("queued", "running"), 300)
        failed = service.client.job(uploaded["job"])
        assert failed["state"] == "failed"
        assert "tile 0 ran out of its worker's memory 3 times" in failed["problem"]["detail"]
        assert "ENVMATTE_INGEST_MEMORY" in failed["problem"]["detail"]
        assert service.client.wait(other["id"])["state"] == "succeeded"
        lines = [line["text"] for line in service.http.get(f"/v1/jobs/{other['id']}/log").json()["lines"]]
        assert not [line for line in lines if " of " in line], lines
    with serving(
        tmp_path / "data", "--workers", "2", **memory, ENVMATTE_INGEST_MEMORY=str(ENOUGH)
    ) as service:
        assert service.http.post(f"/v1/jobs/{uploaded['job']}/retry").status_code == 202
        assert service.client.wait(uploaded["job"])["tiles"]["total"] > 1
    stored = tmp_path / "data" / "store" / "mattes"
    row = Row("a worker out of memory", 1, seconds=[round(time.monotonic() - start, 2)])
    row.differing += digests(stored / other["matte"]) != digests(stored / undisturbed)
    check(table, row)
