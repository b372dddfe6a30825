"""Memory of the server during an upload."""

import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.end_to_end.captures.tus import create, patch
from tests.end_to_end.conftest import Service, serving

GIB = 1 << 30


def in_pieces(service: Service, file: Path) -> dict[str, Any]:
    return service.client.upload(file)


def in_one_patch(service: Service, file: Path) -> dict[str, Any]:
    where = create(service, file.stat().st_size)
    with file.open("rb") as source:
        assert patch(service, where, 0, iter(lambda: source.read(1 << 20), b"")).status_code == 204
    answer = service.http.post("/v1/captures", json={"upload": where.rsplit("/", 1)[1]})
    return dict(answer.json())


def in_one_post(service: Service, file: Path) -> dict[str, Any]:
    with file.open("rb") as source:
        body = iter(lambda: source.read(1 << 20), b"")
        answer = service.http.post("/v1/captures", content=body, headers={"Content-Type": "application/zip"})
    return dict(answer.json())


@pytest.mark.exhaustive
@pytest.mark.parametrize("send", [in_pieces, in_one_patch, in_one_post])
def test_an_upload_of_a_gigabyte_is_streamed(
    capture_archive: Path, tmp_path: Path, send: Callable[[Service, Path], dict[str, Any]]
) -> None:
    large = tmp_path / "large.zip"
    large.write_bytes(capture_archive.read_bytes())
    with zipfile.ZipFile(large, "a") as archive, archive.open("film.raw", "w", force_zip64=True) as entry:
        for _ in range(GIB >> 20):
            entry.write(bytes(1 << 20))
    with serving(tmp_path / "data", "--workers", "1") as service:
        server = psutil.Process(service.process.pid)
        idle = peak = server.memory_info().rss
        done = threading.Event()

        def watch() -> None:
            nonlocal peak
            while not done.wait(0.005):
                peak = max(peak, server.memory_info().rss)

        watcher = threading.Thread(target=watch)
        watcher.start()
        uploaded = send(service, large)
        done.set()
        watcher.join()
        assert uploaded["bytes"] == large.stat().st_size > GIB
        print(f"\n{(peak - idle) / 1e6:.0f} MB above {idle / 1e6:.0f} MB idle")
        assert peak - idle < 200e6
        assert service.client.wait(uploaded["job"])["state"] == "succeeded"
