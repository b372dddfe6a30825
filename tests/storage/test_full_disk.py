"""A disk that is full: told as such, and what was stored before is there."""

import asyncio
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zarr

from storage.database.engine import open_engine, writing
from storage.errors import NoRoom
from storage.objects.store import Objects
from storage.records import uploads
from tests.parts.disks import small_disk
from tests.parts.postgres import TEMPLATE, Server
from tests.services.cluster.clusters import wait

SIZE = 12 << 20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", SIZE) as folder:
        yield folder


def write(objects: Objects, path: str, length: int, piece: int) -> None:
    async def stream() -> None:
        async with objects.write(path) as writer:
            for at in range(0, length, piece):
                await writer.write(os.urandom(min(piece, length - at)))

    asyncio.run(stream())


@pytest.mark.parametrize("piece", [1 << 18, 9 << 20, 2 * SIZE], ids=["crumbs", "parts", "at once"])
def test_a_writer_leaves_nothing_on_a_full_disk(disk: Path, piece: int) -> None:
    objects = Objects((disk / "store").as_uri())
    write(objects, "a", 1000, 1000)
    with pytest.raises(NoRoom, match="free room"):
        write(objects, "b", 2 * SIZE, piece)
    assert {path.name for path in disk.rglob("*") if path.is_file()} == {"a", "a.crc32c"}
    wait(
        lambda: shutil.disk_usage(disk).free > SIZE // 2 + (1 << 20)
    )  # a part under way holds what was removed
    write(objects, "b", SIZE // 2, piece)
    assert objects.names("") == ["a", "b"]


def test_a_small_object_on_a_full_disk(disk: Path) -> None:
    objects = Objects((disk / "store").as_uri())
    with pytest.raises(NoRoom, match="free room"):
        objects.put("a", bytes(SIZE + 1))
    objects.put("a", b"1")
    assert objects.read("a").read() == b"1"


def test_a_chunk_of_an_array_on_a_full_disk(disk: Path) -> None:
    objects = Objects((disk / "store").as_uri())
    array = zarr.create_array(
        objects.zarr,
        name="a",
        shape=(2, SIZE * 2 // 3),
        chunks=(1, SIZE * 2 // 3),
        dtype="u1",
        compressors=None,
    )
    array[0, :] = 1
    with pytest.raises(NoRoom, match="free room"):
        array[1, :] = 1
    assert np.asarray(array[0, :10]).all()


def test_a_sqlite_ledger_on_a_full_disk(disk: Path) -> None:
    engine = open_engine(f"sqlite:///{disk / 'ledger.db'}")
    with writing(engine) as c:
        uploads.add(c, "before", 10, "", 1000.0, None)
    filler = disk / "filler"
    with filler.open("wb", 0) as file:
        while True:
            try:
                file.write(bytes(4096))
            except OSError:
                break
    with pytest.raises(NoRoom, match="free room"), writing(engine) as c:
        uploads.add(c, "upload 0", 10, "x" * 1_000_000, 1000.0, None)
    with engine.connect() as c:
        assert uploads.get(c, "before").length == 10
    filler.unlink()
    with writing(engine) as c:
        uploads.add(c, "upload 0", 10, "", 1000.0, None)
    engine.dispose()


def test_a_postgresql_ledger_on_a_full_disk(postgresql_server: Server) -> None:
    server = postgresql_server
    with small_disk(server.folder / "disk", 2 * SIZE) as disk:
        shutil.chown(disk, server.folder.owner())
        server.execute(f"CREATE TABLESPACE small LOCATION '{disk}'")
        with server.database(like=f"{TEMPLATE} TABLESPACE small") as url:
            engine = open_engine(url)
            with writing(engine) as c:
                uploads.add(c, "before", 10, "", 1000.0, None)
            big = secrets.token_hex(SIZE)  # which does not compress to fit
            with pytest.raises(NoRoom, match="free room"), writing(engine) as c:
                uploads.add(c, "big", 10, big, 1000.0, None)
            with writing(engine) as c:
                assert uploads.get(c, "before").length == 10
                uploads.add(c, "small", 10, "", 1000.0, None)
            engine.dispose()
        server.execute("DROP TABLESPACE small")
