"""The object store over a real folder: streaming in, reading, listing, deleting, and chunks that are missing."""

import asyncio
import io
import os
import socket
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from zarr.storage import MemoryStore

from storage.errors import Corrupt, Unavailable
from storage.objects import store as module
from storage.objects.byte_objects import PART
from storage.objects.checksums import CODECS
from storage.objects.store import Objects, gather
from storage.objects.zarr_store import EVERY_CHUNK


def put(objects: Objects, path: str, data: bytes, piece: int = 1 << 20) -> None:
    async def stream() -> None:
        async with objects.write(path) as writer:
            for at in range(0, len(data), piece):
                await writer.write(data[at : at + piece])

    asyncio.run(stream())


def test_what_is_streamed_in_is_read_back(objects: Objects, folder: Path) -> None:
    data = np.random.default_rng(0).bytes(2 * PART + 12345)
    put(objects, "uploads/a.zip", data)
    assert (folder / "uploads/a.zip").read_bytes() == data
    with objects.read("uploads/a.zip") as file:
        assert file.seekable()
        assert file.read() == data
        assert file.seek(PART - 5) == PART - 5
        assert file.read(10) == data[PART - 5 : PART + 5]
        assert file.tell() == PART + 5
        assert file.seek(-4, io.SEEK_END) == len(data) - 4
        assert file.read(100) == data[-4:]
        assert file.read(1) == b""


def test_zipfile_reads_through_it(objects: Objects) -> None:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one.txt", b"first" * 1000)
        archive.writestr("two.txt", b"second")
    put(objects, "uploads/a.zip", target.getvalue())
    with objects.read("uploads/a.zip") as file, zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None
        assert archive.read("one.txt") == b"first" * 1000


def test_a_writer_left_by_an_error_leaves_no_object(objects: Objects, folder: Path) -> None:
    async def broken() -> None:
        async with objects.write("uploads/a.zip") as writer:
            await writer.write(bytes(PART + 1))
            raise ConnectionError("the client went away")

    with pytest.raises(ConnectionError):
        asyncio.run(broken())
    assert not [path for path in folder.rglob("*") if path.is_file()]
    with pytest.raises(FileNotFoundError):
        objects.read("uploads/a.zip")


def test_listing_and_deleting(objects: Objects, folder: Path) -> None:
    for path in ("c/1/x", "c/1/deep/y", "c/2/x", "c/10/x", "c/file"):
        put(objects, path, b"data")
    assert objects.names("c") == ["1", "10", "2", "file"]
    assert objects.names("none") == []
    assert objects.paths_below("c/1") == {"c/1/x", "c/1/deep/y"}
    objects.delete("c/1")
    assert objects.names("c") == ["10", "2", "file"]
    assert not (folder / "c/1").exists()
    objects.delete("c/file")
    objects.delete("c/1")
    objects.delete("never/there")
    assert objects.names("c") == ["10", "2"]


def test_a_folder_is_made_and_can_be_opened_again(objects: Objects, folder: Path) -> None:
    assert folder.is_dir()
    put(objects, "a", b"1")
    again = Objects(folder.as_uri())
    again.check_reachable()
    assert again.read("a").read() == b"1"


def test_a_group_that_is_not_there(objects: Objects) -> None:
    with pytest.raises(FileNotFoundError):
        gather(objects.group("captures/none"))
    with pytest.raises(FileNotFoundError):
        gather(objects.array("captures/none"))


@pytest.mark.parametrize(
    "values", [np.arange(5, dtype=np.uint32), np.zeros(3, np.float32), np.empty(0, "u2")]
)
def test_an_array_put_is_the_one_zarr_makes(
    objects: Objects, digests: Callable[[str], dict[str, str]], values: NDArray[np.generic]
) -> None:
    laid_out = MemoryStore()
    chunks = (max(len(values), 1),)
    zarr.create_array(
        laid_out, name="g/a", data=values, chunks=chunks, config=EVERY_CHUNK, compressors=CODECS
    )
    objects.put_tree("", laid_out)
    plain = digests("g")
    objects.delete("g")
    for earlier in (np.arange(9.0), values):
        gather(objects.put_group("g"), objects.put_array("g/a", earlier))
    assert digests("g") == plain


def test_an_array_that_was_made_anew_is_opened_anew(objects: Objects) -> None:
    for values in (np.arange(3), np.arange(7.0)):
        gather(objects.put_array("a", values))
        (array,) = gather(objects.array("a"))
        np.testing.assert_array_equal(array[:], values)
        assert array.dtype == values.dtype
    objects.delete("a")
    with pytest.raises(FileNotFoundError):
        gather(objects.array("a"))


def test_together_all_ends_before_the_first_error_is_raised() -> None:
    ended = []

    async def work(seconds: float, error: Exception | None = None) -> float:
        await asyncio.sleep(seconds)
        ended.append(seconds)
        if error:
            raise error
        return seconds

    assert gather(work(0.02), work(0.0), work(0.01)) == [0.02, 0.0, 0.01]
    assert ended == [0.0, 0.01, 0.02]
    with pytest.raises(KeyError):
        gather(work(0.03), work(0.02, KeyError()), work(0.01, ValueError()))
    assert ended[3:] == [0.01, 0.02, 0.03]


def test_together_from_threads_and_from_a_running_loop() -> None:
    async def double(n: int) -> int:
        return 2 * n

    async def inside() -> list[int]:
        return gather(double(1), double(2))

    assert asyncio.run(inside()) == [2, 4]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(lambda n: gather(double(n)), range(50))) == [[2 * n] for n in range(50)]


def test_a_missing_chunk_is_an_error_and_not_a_zero(objects: Objects, folder: Path) -> None:
    array = zarr.create_array(objects.zarr, name="a", shape=(4, 6), chunks=(2, 3), dtype="uint8")
    array[:2] = 1
    assert np.asarray(array[:2, 1:5]).min() == 1
    with pytest.raises(Corrupt, match=r"a/c/1/[01] is missing"):
        array[1:3]
    (folder / "a/c/0/1").unlink()
    assert np.asarray(array[:2, :3]).min() == 1
    with pytest.raises(Corrupt, match="a/c/0/1 is missing"):
        array[:2]


def test_what_a_killed_writer_left_is_swept(objects: Objects, folder: Path) -> None:
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "b" / "whole").write_bytes(b"1")
    (folder / "a" / "b" / "half#1").write_bytes(b"1")
    objects.sweep("a")
    assert [path.name for path in folder.rglob("*") if path.is_file()] == ["whole"]
    (folder / "a" / "b" / "half#2").write_bytes(b"1")
    objects.delete("a")
    assert not (folder / "a").exists()


def test_a_folder_with_an_odd_name_is_itself(tmp_path: Path) -> None:
    odd = tmp_path / "a folder, 100 % ä"
    Objects(odd.as_uri()).sweep("nothing")
    store = Objects(odd.as_uri())
    (odd / "x").write_bytes(b"1")
    assert store.names("") == ["x"]
    store.delete("x")
    assert list(odd.iterdir()) == []


def test_what_nobody_writes_to_is_stale(objects: Objects) -> None:
    put(objects, "c/old/deep/x", b"1")
    put(objects, "c/busy/deep/x", b"1")
    put(objects, "c/busy/zarr.json", b"1")
    put(objects, "c/object", b"1")
    assert objects.stale_names("c", 3600) == []
    assert objects.stale_names("none", 0) == []
    time.sleep(2)  # a bucket's times are whole seconds
    put(objects, "c/busy/deep/x", b"2")
    assert objects.stale_names("c", 1.5) == ["object", "old"]
    assert objects.stale_names("c", 1.5, but={"old"}) == ["object"]
    assert objects.stale_names("c", -10) == ["busy", "object", "old"]


def test_a_file_under_way_and_an_empty_folder_count_in_a_folder(objects: Objects, folder: Path) -> None:
    for path in (folder / "c" / "under way" / "x#1", folder / "c" / "left"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"1")
    (folder / "c" / "empty").mkdir()
    for path in ("c/under way", "c/empty", "c/left"):
        os.utime(folder / path, (1000, 1000))
    assert objects.stale_names("c", 3600) == ["empty", "left"]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gives up on a bucket at once, and not after a minute."""
    backoff = {
        "init_backoff": timedelta(milliseconds=1),
        "max_backoff": timedelta(milliseconds=10),
        "base": 2,
    }
    monkeypatch.setattr(module, "RETRIES", module.RETRIES | {"max_retries": 1, "backoff": backoff})
    monkeypatch.setattr(module, "REQUESTS", module.REQUESTS | {"timeout": timedelta(seconds=1)})


@pytest.fixture(params=["refused", "silent", "503", "429"])
def nobody(
    impatient: None, request: pytest.FixtureRequest, s3: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """A store whose bucket does not answer, or is too busy to."""

    class Busy(BaseHTTPRequestHandler):
        def _refuse(self) -> None:
            self.send_response(int(request.param))
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _refuse

        def log_message(self, format: str, *args: object) -> None:
            pass

    if request.param in ("503", "429"):
        with ThreadingHTTPServer(("127.0.0.1", 0), Busy) as server:
            threading.Thread(target=server.serve_forever).start()
            monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
            yield s3
            server.shutdown()
        return
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        if request.param == "silent":
            taken.listen(100)
            short = module.REQUESTS | {"timeout": timedelta(seconds=0.2)}
            monkeypatch.setattr(module, "REQUESTS", short)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{taken.getsockname()[1]}")
        yield s3


def test_a_bucket_that_cannot_be_reached_is_told_whatever_is_asked(nobody: str) -> None:
    objects = Objects(nobody)
    array = np.zeros(3)
    asked: list[Callable[[], object]] = [
        objects.check_reachable,
        lambda: objects.read("a"),
        lambda: objects.put("a", b"1"),
        lambda: put(objects, "a", b"1"),
        lambda: put(objects, "a", bytes(PART + 1)),
        lambda: objects.names("a"),
        lambda: objects.paths_below("a"),
        lambda: objects.stale_names("a", 1),
        lambda: objects.delete("a"),
        lambda: gather(objects.group("a")),
        lambda: gather(objects.array("a")),
        lambda: gather(objects.put_array("a", array)),
        lambda: zarr.create_array(objects.zarr, name="a", data=array),
        lambda: zarr.open_group(objects.zarr, path="a"),
    ]
    for ask in asked:
        with pytest.raises(Unavailable, match="try again"):
            ask()


def test_a_bucket_that_goes_away_while_it_is_read(impatient: None, s3: str) -> None:
    there = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://").split(":")
    with socket.create_server(("127.0.0.1", 0)) as between:
        os.environ["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{between.getsockname()[1]}"
        sockets: list[socket.socket] = []

        def relay() -> None:
            while True:
                try:
                    near, _ = between.accept()
                except OSError:
                    return
                far = socket.create_connection((there[0], int(there[1])))
                sockets.extend((near, far))
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=carry, args=(one, other)).start()

        def carry(one: socket.socket, other: socket.socket) -> None:
            try:
                while data := one.recv(1 << 16):
                    other.sendall(data)
            except OSError:
                pass

        thread = threading.Thread(target=relay)
        thread.start()
        objects = Objects(s3)
        data = np.random.default_rng(0).bytes(3 << 20)
        put(objects, "a", data)
        with objects.read("a") as file:
            assert file.read(1000) == data[:1000]
            between.shutdown(socket.SHUT_RDWR)
            thread.join()
            for one in sockets:
                one.close()
            with pytest.raises(Unavailable):
                file.read()


def test_a_bucket_that_is_not_there_is_no_matter_of_waiting(s3: str) -> None:
    objects = Objects(s3.replace("envmatte", "nobodys"))
    with pytest.raises(Exception, match="NoSuchBucket") as caught:
        objects.check_reachable()
    assert not isinstance(caught.value, Unavailable)
