"""Parts of uploads in the store: read as one file, missing or damaged, and removed."""

import io

import numpy as np
import pytest

from storage.errors import Corrupt
from storage.layout import uploads
from storage.layout.uploads import Part
from storage.objects.store import Objects


def stored(objects: Objects, upload: str, pieces: list[bytes]) -> list[Part]:
    parts = [Part(f"p{n}", len(piece)) for n, piece in enumerate(pieces)]
    for part, piece in zip(parts, pieces, strict=True):
        objects.put(uploads.part_path(upload, part.name), piece)
    return parts


@pytest.mark.parametrize("sizes", [[], [0], [1], [5, 1, 70_000, 200_000, 3], [1 << 20, 1 << 17]])
def test_parts_are_read_as_one_file(objects: Objects, sizes: list[int]) -> None:
    rng = np.random.default_rng(1)
    pieces = [rng.bytes(size) for size in sizes]
    whole = b"".join(pieces)
    uploads.seal(objects, "u", stored(objects, "u", pieces))
    with uploads.read(objects, "u") as file:
        assert file.read() == whole
        assert file.read(5) == b""
        twin = io.BytesIO(whole)
        for _ in range(200):
            at, count = (int(n) for n in rng.integers(0, len(whole) + 10, 2))
            assert file.seek(at) == twin.seek(at)
            assert file.read(count) == twin.read(count)
        assert file.seek(-len(whole), io.SEEK_END) == 0
        assert (file.seek(2, io.SEEK_CUR), file.tell()) == (2, 2)
        with pytest.raises(ValueError, match="before the start"):
            file.seek(-len(whole) - 1, io.SEEK_END)


def test_missing_part_is_found_before_reading(objects: Objects) -> None:
    with pytest.raises(FileNotFoundError):
        uploads.read(objects, "u")
    uploads.seal(objects, "u", stored(objects, "u", [b"one", b"two"]))
    objects.delete(uploads.part_path("u", "p1"))
    with pytest.raises(FileNotFoundError, match="p1"):
        uploads.read(objects, "u")


def test_short_part_is_corrupt(objects: Objects) -> None:
    uploads.seal(objects, "u", stored(objects, "u", [b"one", b"two"]))
    objects.put(uploads.part_path("u", "p0"), b"on")
    with uploads.read(objects, "u") as file, pytest.raises(Corrupt, match=r"p0\.part is shorter"):
        file.read()


def test_sweep_removes_leftovers_of_killed_writers(objects: Objects) -> None:
    parts = stored(objects, "u", [b"one", b"two", b"three"])
    uploads.sweep(objects, "u", [part.name for part in parts[:2]])
    assert objects.names("uploads/u") == ["p0.part", "p1.part"]
    uploads.sweep(objects, "u", [])
    assert objects.names("uploads/u") == []


def test_remove_deletes_all_objects_of_one_upload(objects: Objects) -> None:
    uploads.seal(objects, "u", stored(objects, "u", [b"one"]))
    stored(objects, "v", [b"another's"])
    uploads.remove(objects, "u")
    uploads.remove(objects, "u")
    assert objects.names("uploads") == ["v"]
