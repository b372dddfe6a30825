"""The cache of textures for graphics hardware."""

from pathlib import Path

import pytest
import zarr

from storage.layout import live, mattes
from storage.objects.store import Objects

FORMAT = "live-1"


@pytest.fixture
def objects(tmp_path: Path) -> Objects:
    made = Objects(tmp_path.as_uri())
    mattes.create(made, "m", height=4, width=5, columns=8, rows=6)
    return made


def test_cached_bytes_are_read_until_matte_is_deleted(objects: Objects) -> None:
    assert live.read(objects, "m", FORMAT) is None
    live.write(objects, "m", FORMAT, bytes(range(256)))
    live.write(objects, "m", FORMAT, b"another")
    assert live.read(objects, "m", FORMAT) == b"another"
    assert live.read(objects, "m", "live-2") is None
    objects.delete(mattes.path("m"))
    assert live.read(objects, "m", FORMAT) is None


def test_incomplete_cache_reads_as_none(objects: Objects, tmp_path: Path) -> None:
    live.write(objects, "m", FORMAT, b"whole")
    (tmp_path / "mattes/m" / FORMAT / "c/0").unlink()
    assert live.read(objects, "m", FORMAT) is None


def test_cache_is_an_array_of_the_mattes_group(objects: Objects, tmp_path: Path) -> None:
    live.write(objects, "m", FORMAT, b"bytes")
    group = zarr.open_group(tmp_path / "mattes/m", mode="r")
    assert FORMAT in dict(group.members())
    assert bytes(group[FORMAT][:]) == b"bytes"
