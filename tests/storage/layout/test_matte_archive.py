"""Matte archives: their bytes and size, and missing objects."""

import hashlib
import io
import json
import os
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.storage import ZipStore

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.matte_archive import MANIFEST, Archive, _entry, _Tail, zip_size
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.storage.layout.matte_blocks import block, extent, places, zeros


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """A matte with one block without rows T."""
    made = mattes.create(
        objects, "m", height=21, width=40, columns=4, rows=3, monitor=[8, 6], options={"method": "lobes"}
    )
    for row, column in places(made):
        size = extent(made, row, column)
        written = zeros(*size, 0) if (row, column) == (0, 1) else block(*size, seed=10 * row + column)
        made.write(row, column, written)
    return made


def test_zarr_opens_archive(objects: Objects, matte: Matte, tmp_path: Path) -> None:
    (tmp_path / "matte.zip").write_bytes(b"".join(Archive(objects, "m")))
    with ZipStore(tmp_path / "matte.zip", mode="r") as store:
        group = zarr.open_group(store, mode="r")
        assert group.attrs.asdict().keys() - matte.attributes.keys() == {"crc32c"}
        assert matte.attributes.items() <= group.attrs.asdict().items()
        for name in mattes.FRAMES:
            np.testing.assert_array_equal(group[name][:], matte.layer(name))
        expected = matte.read(1, 2)
        np.testing.assert_array_equal(group["T/1.2/cell"][:], expected.cell)
        np.testing.assert_array_equal(group["T/1.2/weight"][:], expected.weight)
        assert group["T/0.1/cell"].shape == (0,)


def test_manifest_lists_every_entry_and_no_origin(objects: Objects, matte: Matte) -> None:
    with zipfile.ZipFile(io.BytesIO(b"".join(Archive(objects, "m")))) as archive:
        assert archive.testzip() is None
        names = archive.namelist()
        manifest = json.loads(archive.read(MANIFEST))
        stored = {path.removeprefix("mattes/m/") for path in objects.paths_below("mattes/m")}
        assert set(names) == stored | {MANIFEST}
        assert names[-1] == MANIFEST
        assert manifest == {
            "format": "envmatte-archive/1",
            "matte": {
                "width": 40,
                "height": 21,
                "monitor": [8, 6],
                "columns": 4,
                "rows": 3,
                "block": 16,
                "options": {"method": "lobes"},
            },
            "members": {
                name: {
                    "size": len(archive.read(name)),
                    "sha256": hashlib.sha256(archive.read(name)).hexdigest(),
                }
                for name in sorted(stored)
            },
        }
        assert all(archive.read(name) == objects.read(f"mattes/m/{name}").read() for name in stored)


def test_same_matte_gives_same_bytes_of_announced_size(objects: Objects, matte: Matte) -> None:
    first = Archive(objects, "m")
    pieces = list(first)
    assert sum(map(len, pieces)) == first.size
    assert len(pieces) == len(places(matte)) + 2  # the documents, the blocks, the manifest
    os.environ["TZ"], before = "Pacific/Auckland", os.environ.get("TZ")
    time.tzset()
    try:
        assert b"".join(Archive(objects, "m")) == b"".join(pieces)
    finally:
        os.environ.pop("TZ") if before is None else os.environ.update(TZ=before)
        time.tzset()


def test_incomplete_matte_is_corrupt(objects: Objects, matte: Matte) -> None:
    for name in ("S/c/1/2/0", "T/1.2/weight/c/0", "T/0.1/zarr.json", "rho/zarr.json"):
        data = objects.read(f"mattes/m/{name}").read()
        objects.delete(f"mattes/m/{name}")
        with pytest.raises(Corrupt):
            Archive(objects, "m")
        objects.put(f"mattes/m/{name}", data)
    Archive(objects, "m")


@pytest.mark.parametrize("change", ["deleted", "cut"])
def test_archive_of_changing_matte_is_invalid(objects: Objects, matte: Matte, change: str) -> None:
    archive = iter(Archive(objects, "m"))
    sent = next(archive) + next(archive)
    if change == "deleted":
        objects.delete("mattes/m")
    else:
        objects.put("mattes/m/S/c/0/1/0", b"cut")
    with pytest.raises(Corrupt):
        sent += b"".join(archive)
    assert not zipfile.is_zipfile(io.BytesIO(sent))


@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"a": 0},
        {f"{n:x}": n % 3 for n in range(70_000)},
        {"a": 1 << 20, **{f"{n:04}": (1 << 20) - 7 for n in range(2_060)}},
    ],
    ids=["empty", "one", "many", "large"],
)
def test_size_is_known_in_advance(sizes: dict[str, int]) -> None:
    zeroes = bytes(1 << 20)
    written, size = _Tail(), 0
    archive = zipfile.ZipFile(written, "w")  # type: ignore[call-overload]
    for name, of in sizes.items():
        archive.writestr(_entry(name), zeroes[:of])
        size += len(written.take())
    archive.close()
    assert size + len(written.take()) == zip_size(sizes)
