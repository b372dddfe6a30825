"""Checksums: damage is reported wherever it is read; objects without checksums are read."""

import json
from collections.abc import Callable
from typing import Any

import google_crc32c
import numpy as np
import pytest
import zarr

from storage.errors import Corrupt
from storage.layout import captures, composites, live, uploads
from storage.layout.captures import Stack
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Matte
from storage.objects.checksums import BLOCK, CODECS, Table, crc32c, is_intact, seal, unseal
from storage.objects.event_loop import gather
from storage.objects.store import Objects
from tests.storage.installation import ARCHIVE, flip, stream

READS: dict[str, tuple[str, Callable[[Objects], Any]]] = {
    "frames": ("captures/c/frames/c/0/0/0/0", lambda o: Stack(o, "c").read()),
    "mask": ("captures/c/mask/c/0/0", lambda o: Stack(o, "c").mask()),
    "images": ("captures/c/images/0/c/0/0/0", lambda o: Stack(o, "c").images()),
    "shares": ("captures/c/shares/c/0/0", lambda o: Stack(o, "c").shares()),
    "manifest": ("captures/c/zarr.json", lambda o: Stack(o, "c")),
    "measured": ("captures/c/measured/zarr.json", lambda o: Stack(o, "c")),
    "stack": ("captures/c/frames/zarr.json", lambda o: Stack(o, "c")),
    "figures": ("mattes/m/zarr.json", lambda o: Matte(o, "m")),
    "layer": ("mattes/m/rho/c/0/0/0", lambda o: Matte(o, "m").layer("rho")),
    "truths": ("mattes/m/shared/c/1/2", lambda o: Matte(o, "m").read(1, 2)),
    "cells": ("mattes/m/T/1.2/cell/c/0", lambda o: Matte(o, "m").read(1, 2)),
    "weights": ("mattes/m/T/1.2/weight/c/0", lambda o: Matte(o, "m").read(1, 2)),
    "rows": ("mattes/m/T/1.2/weight/zarr.json", lambda o: list(Archive(o, "m"))),
    "export": ("mattes/m/T/1.2/weight/c/0", lambda o: list(Archive(o, "m"))),
    "part": ("uploads/i/all.part", lambda o: uploads.read(o, "i").read()),
    "index": ("uploads/i/parts.json", lambda o: uploads.read(o, "i")),
    "clip": ("composites/w/clip", lambda o: o.read(composites.clip_path("w")).read()),
    "video": ("composites/v/video.mp4", lambda o: o.read(composites.video_path("v")).read()),
    "table": ("composites/v/video.mp4.crc32c", lambda o: o.read(composites.video_path("v")).read()),
}


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_flipped_bit_is_reported_by_path_wherever_read(filled: Objects) -> None:
    for path, read in READS.values():
        read(filled)
        for at in (0.0, 0.5, 1.0):
            flip(filled, path, at)
            with pytest.raises(Corrupt) as caught:
                read(filled)
            assert path in caught.value.detail or path.partition("/m/")[2] in caught.value.detail
            assert "again" in caught.value.detail
            flip(filled, path, at)
        read(filled)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_damaged_cache_for_browsers_reads_as_none(filled: Objects) -> None:
    assert live.read(filled, "m", "live-1") is not None
    flip(filled, "mattes/m/live-1/c/0")
    assert live.read(filled, "m", "live-1") is None


def test_range_is_read_although_another_block_is_damaged(objects: Objects) -> None:
    stream(objects, "uploads/u/p.part", ARCHIVE)
    flip(objects, "uploads/u/p.part")
    with objects.read("uploads/u/p.part") as file:
        assert file.read(1000) == ARCHIVE[:1000]
        file.seek(2 * BLOCK)
        assert file.read() == ARCHIVE[2 * BLOCK :]
        file.seek(BLOCK - 10)
        with pytest.raises(Corrupt, match=r"uploads/u/p\.part is damaged"):
            file.read(20)


@pytest.mark.parametrize("cut", [-1, 1])
def test_wrong_length_is_corrupt(objects: Objects, cut: int) -> None:
    stream(objects, "a/b", ARCHIVE[:BLOCK])
    objects.write_raw("a/b", iter([ARCHIVE[: BLOCK + cut]]))
    with pytest.raises(Corrupt, match="a/b is damaged"), objects.read("a/b") as file:
        file.read()


def test_objects_without_checksums_are_read(objects: Objects) -> None:
    values = np.arange(24, dtype=np.uint16).reshape(1, 2, 4, 3)
    captures.create_stack(
        objects, "c", values.shape, values.dtype, memory=1000, attributes={"a": 1}, mask=None, images=()
    )
    group = zarr.create_group(objects.zarr, path="captures/c", attributes={"a": 1}, overwrite=True)
    group.create_array("frames", data=values, chunks=values.shape)
    stack = Stack(objects, "c")
    np.testing.assert_array_equal(stack.read(), values)
    assert stack.attributes == {"a": 1}
    flip(objects, "captures/c/frames/c/0/0/0/0", 0.0)  # of zstd's magic number
    with pytest.raises(Corrupt, match=r"frames/c/0/0/0/0 is damaged .* upload it again"):
        stack.read()
    objects.write_raw("uploads/u/p.part", iter([b"any"]))
    assert objects.read("uploads/u/p.part").read() == b"any"


def test_chunk_checksums_are_those_of_zarr(objects: Objects) -> None:
    gather(objects.put_array("a", np.arange(1000)))
    document = json.loads(objects.read_raw("a/zarr.json"))
    assert [codec["name"] for codec in document["codecs"]] == ["bytes", "zstd", "crc32c"]
    assert [codec.to_dict() for codec in CODECS] == document["codecs"][1:]
    assert is_intact(objects.read_raw("a/c/0"))
    assert crc32c(b"123456789") == 0xE3069283  # RFC 3720's check value


def test_table_does_not_depend_on_pieces() -> None:
    whole, pieces = Table(), Table()
    whole.update(ARCHIVE)
    for at in range(0, len(ARCHIVE), 77_777):
        pieces.update(memoryview(ARCHIVE)[at : at + 77_777])
    assert whole.to_bytes() == pieces.to_bytes()
    sums = np.frombuffer(whole.to_bytes()[:-4], "<u4")
    assert list(sums) == [
        google_crc32c.value(ARCHIVE[at : at + BLOCK]) for at in range(0, len(ARCHIVE), BLOCK)
    ]
    assert len(Table().to_bytes()) == 4


def test_sealed_document_is_checked_but_not_its_formatting() -> None:
    document = {"attributes": {"x": [0.1, None, "é"]}, "zarr_format": 3}
    sealed = seal(json.dumps(document).encode())
    assert seal(sealed) == sealed
    assert unseal("a", sealed) == (document, True)
    assert unseal("a", json.dumps(json.loads(sealed), indent=2).encode()) == (document, True)
    assert unseal("a", json.dumps(document, indent=2).encode()) == (document, False)
    for damage in (
        b"",
        b"[]",
        b"{",
        b'{"attributes": 3}',
        sealed.replace(b"0.1", b"0.2"),
        sealed.replace(b"crc", b"crs"),
        b"\xff" + sealed[1:],
    ):
        with pytest.raises(Corrupt, match=r"^captures/c/zarr\.json is damaged"):
            unseal("captures/c/zarr.json", damage)
