"""The object store: streaming, reading, listing, deleting, arrays, and concurrent requests."""

import asyncio
import io
import os
import threading
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from obstore.exceptions import BaseError
from zarr.storage import MemoryStore

from storage.errors import Corrupt, StoreUnavailable
from storage.objects.byte_objects import PART
from storage.objects.checksums import CODECS
from storage.objects.event_loop import gather
from storage.objects.store import Objects
from storage.objects.zarr_store import EVERY_CHUNK
from tests.storage.installation import stream


def test_streamed_object_is_read_back(objects: Objects, folder: Path) -> None:
    data = np.random.default_rng(0).bytes(2 * PART + 12345)
    stream(objects, "uploads/a.zip", data)
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


def test_a_folder_that_cannot_be_made_is_named() -> None:
    with pytest.raises(StoreUnavailable, match=r"cannot open the store file:///proc/x: .*ENVMATTE_STORE"):
        Objects("file:///proc/x")


def test_zipfile_reads_object(objects: Objects) -> None:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one.txt", b"first" * 1000)
        archive.writestr("two.txt", b"second")
    stream(objects, "uploads/a.zip", target.getvalue())
    with objects.read("uploads/a.zip") as file, zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None
        assert archive.read("one.txt") == b"first" * 1000


def test_failed_writer_leaves_no_object(objects: Objects, folder: Path) -> None:
    async def broken() -> None:
        async with objects.write("uploads/a.zip") as writer:
            await writer.write(bytes(PART + 1))
            raise ConnectionError("the client went away")

    with pytest.raises(ConnectionError):
        asyncio.run(broken())
    assert not [path for path in folder.rglob("*") if path.is_file()]
    with pytest.raises(FileNotFoundError):
        objects.read("uploads/a.zip")


@pytest.mark.parametrize("write", [Objects.put, stream])
def test_object_whose_checksums_cannot_be_written_is_not_kept(
    objects: Objects, folder: Path, write: Callable[[Objects, str, bytes], None]
) -> None:
    (folder / "a.crc32c" / "in the way").mkdir(parents=True)
    with pytest.raises(BaseError):
        write(objects, "a", b"data")
    with pytest.raises(FileNotFoundError):  # not one without checksums
        objects.read("a")


def test_deleted_folders_and_files_are_listed_no_more(objects: Objects, folder: Path) -> None:
    for path in ("c/1/x", "c/1/deep/y", "c/2/x", "c/10/x", "c/file"):
        stream(objects, path, b"data")
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
    assert set(objects.sizes("c")) == {"c/10/x", "c/10/x.crc32c", "c/2/x", "c/2/x.crc32c"}


def test_folder_is_removed_while_others_write_into_it_and_remove_it(tmp_path: Path) -> None:
    objects = Objects(tmp_path.as_uri())
    ended = threading.Event()

    def write() -> None:
        while not ended.wait(0.003):
            with suppress(OSError):  # its folder was removed between two steps
                objects.write_raw("mattes/m/deep/er/chunk", iter([b"data"]))

    def remove() -> None:
        for _ in range(150):
            objects.delete("mattes/m")

    with ThreadPoolExecutor(4) as pool:
        writers = [pool.submit(write) for _ in range(2)]
        removers = [pool.submit(remove) for _ in range(2)]
        try:
            for one in removers:
                one.result()
        finally:
            ended.set()
        for one in writers:
            one.result()
    objects.delete("mattes/m")
    assert not (tmp_path / "mattes/m").exists()


def test_folder_is_created_and_reopened(objects: Objects, folder: Path) -> None:
    assert folder.is_dir()
    stream(objects, "a", b"1")
    again = Objects(folder.as_uri())
    again.check_reachable()
    assert again.read("a").read() == b"1"


def test_missing_group_or_array_is_not_found(objects: Objects) -> None:
    with pytest.raises(FileNotFoundError):
        gather(objects.group("captures/none"))
    with pytest.raises(FileNotFoundError):
        gather(objects.array("captures/none"))


@pytest.mark.parametrize(
    "values", [np.arange(5, dtype=np.uint32), np.zeros(3, np.float32), np.empty(0, "u2")]
)
def test_put_array_equals_array_of_zarr(
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


def test_replaced_array_is_opened_as_new(objects: Objects) -> None:
    for values in (np.arange(3), np.arange(7.0)):
        gather(objects.put_array("a", values))
        (array,) = gather(objects.array("a"))
        np.testing.assert_array_equal(array[:], values)
        assert array.dtype == values.dtype
    objects.delete("a")
    with pytest.raises(FileNotFoundError):
        gather(objects.array("a"))


def test_missing_chunk_is_an_error(objects: Objects, folder: Path) -> None:
    array = zarr.create_array(objects.zarr, name="a", shape=(4, 6), chunks=(2, 3), dtype="uint8")
    array[:2] = 1
    assert np.asarray(array[:2, 1:5]).min() == 1
    with pytest.raises(Corrupt, match=r"a/c/1/[01] is missing"):
        array[1:3]
    (folder / "a/c/0/1").unlink()
    assert np.asarray(array[:2, :3]).min() == 1
    with pytest.raises(Corrupt, match="a/c/0/1 is missing"):
        array[:2]


def test_sweep_removes_unfinished_files(objects: Objects, folder: Path) -> None:
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "b" / "whole").write_bytes(b"1")
    (folder / "a" / "b" / "half#1").write_bytes(b"1")
    objects.sweep("a", objects.written_at("a"))
    assert (folder / "a" / "b" / "half#1").exists()
    objects.sweep("a")
    assert [path.name for path in folder.rglob("*") if path.is_file()] == ["whole"]
    (folder / "a" / "b" / "half#2").write_bytes(b"1")
    objects.delete("a")
    assert not (folder / "a").exists()


def test_folder_name_with_special_characters(tmp_path: Path) -> None:
    odd = tmp_path / "a folder, 100 % ä"
    Objects(odd.as_uri()).sweep("nothing")
    store = Objects(odd.as_uri())
    (odd / "x").write_bytes(b"1")
    assert store.names("") == ["x"]
    store.delete("x")
    assert list(odd.iterdir()) == []


def test_objects_are_dated_by_the_clock_of_the_store(objects: Objects) -> None:
    for path in ("c/old/deep/x", "c/busy/deep/x", "c/busy/zarr.json", "c/object"):
        stream(objects, path, b"1")
    time.sleep(1.1)  # a bucket's times are whole seconds
    before = objects.clock()
    assert objects.names("") == ["c"]
    stream(objects, "c/busy/deep/x", b"2")
    old = [name for name in objects.names("c") if objects.written_at(f"c/{name}") < before]
    assert old == ["object", "old"]
    assert before <= objects.written_at("c/busy") <= objects.clock()
    assert objects.written_at("none") == np.inf


def test_unfinished_files_and_empty_folders_are_dated(objects: Objects, folder: Path) -> None:
    for path in (folder / "c" / "under way" / "x#1", folder / "c" / "left"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"1")
    (folder / "c" / "empty").mkdir()
    for path in ("c/under way", "c/empty", "c/left"):
        os.utime(folder / path, (1000, 1000))
    hour_ago = objects.clock() - 3600
    assert [name for name in objects.names("c") if objects.written_at(f"c/{name}") < hour_ago] == [
        "empty",
        "left",
    ]
