"""A matte read where it lies in its archive, block by block."""

import io
import pickle
import zipfile
from pathlib import Path

import dask
import numpy as np
import pytest

from storage.errors import ArchiveError
from storage.layout.matte_archive import MANIFEST, block_entries
from storage.layout.mattes import FRAMES, Matte
from tests.workflows.mattes.imports.conftest import packed, unpacked
from workflows.mattes import layers
from workflows.mattes.dataset import dataset_of
from workflows.mattes.imports.archived import ArchivedMatte
from workflows.mattes.lobes import block_lobes
from workflows.recovery.clusters.lobe_table import FIELDS


class Watched(io.BytesIO):
    """An archive that notes which places of it are read."""

    def __init__(self, archive: bytes) -> None:
        super().__init__(archive)
        self.places: list[tuple[int, int]] = []
        self.is_pickled = False

    def __reduce_ex__(self, protocol: object) -> tuple[object, ...]:
        self.is_pickled = True
        raise TypeError("a file that is watched stays where it is")

    def read(self, size: int | None = -1) -> bytes:
        at = self.tell()
        data = super().read(size)
        self.places.append((at, at + len(data)))
        return data

    def entries(self) -> set[str]:
        """The entries that were read since the last call; the archive's directory aside."""
        places, self.places = self.places, []
        with zipfile.ZipFile(io.BytesIO(self.getvalue())) as file:
            found = file.infolist()
            ends = [*(info.header_offset for info in found[1:]), file.start_dir]
        return {
            info.filename
            for info, end in zip(found, ends, strict=True)
            if any(first < end and last > info.header_offset for first, last in places)
        }


def test_blocks_equal_those_of_the_store(matte: Matte, archive: bytes) -> None:
    read = ArchivedMatte(io.BytesIO(archive))
    assert read.attributes == matte.attributes
    for row, column in np.ndindex(matte.block_rows, matte.block_columns):
        ours, stored = read.read(row, column), matte.read(row, column)
        for name in ("count", "cell", "weight"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(stored, name))
        for name in FRAMES:
            np.testing.assert_array_equal(read.chunk(name, row, column), matte.chunk(name, row, column))


def test_dataset_has_the_layers_and_lobes_of_the_service(matte: Matte, archive: bytes) -> None:
    found = dataset_of(ArchivedMatte(io.BytesIO(archive)), lobes=3).compute()
    for name in layers.NAMES:
        expected = layers.layer(matte, name)
        values = found[name].to_numpy()
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values.reshape(expected.shape), expected)
    for row, column in np.ndindex(matte.block_rows, matte.block_columns):
        at = matte.span(row, column)
        lobes = block_lobes(matte, matte.read(row, column), 3)
        for k, name in enumerate(FIELDS):
            variable, _, channel = name.partition(".")
            values = found[variable].sel(channel=channel) if channel else found[variable]
            np.testing.assert_array_equal(values.to_numpy()[at], lobes[..., k])
    assert found.attrs["monitor"] == matte.attributes["monitor"]
    np.testing.assert_array_equal(np.reshape(found.attrs["crosstalk"], (3, 3)), matte.attributes["crosstalk"])
    assert "interval" not in found.attrs  # no ingest has measured it


def test_dataset_has_the_interval_in_its_attributes(matte: Matte, archive: bytes) -> None:
    read = ArchivedMatte(io.BytesIO(archive))
    read.attributes["interval"] = {"share": 4.0, "read": 2.0, "contrast": 1.0, "shot": 3.0}
    assert dataset_of(read).attrs["interval"] == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("variable", "arrays"),
    [("S", ("S",)), ("alpha", ("recovered",)), ("confidence", ("error", "recovered")), ("u", None)],
)
def test_only_what_is_asked_for_is_read(
    archive: bytes, variable: str, arrays: tuple[str, ...] | None
) -> None:
    watched = Watched(archive)
    found = dataset_of(ArchivedMatte(watched))
    assert not watched.is_pickled  # by dask, for names of tasks
    described = watched.entries()
    assert described >= {MANIFEST, "zarr.json", "S/zarr.json"}
    assert not any("/c/" in entry for entry in described)
    with dask.config.set(scheduler="synchronous"):
        found[variable].isel(y=18, x=3).compute()
    of_block = set(block_entries(1, 0))
    expected = of_block if arrays is None else {name for name in of_block if name.startswith(arrays)}
    assert watched.entries() == expected


def test_a_dataset_goes_to_other_processes(matte: Matte, archive: bytes, tmp_path: Path) -> None:
    file = tmp_path / "matte.zip"
    file.write_bytes(archive)
    found = pickle.loads(pickle.dumps(dataset_of(ArchivedMatte(file))))
    np.testing.assert_array_equal(found.rho.compute(), layers.layer(matte, "rho"))


@pytest.mark.parametrize("lobes", [0, 9])
def test_lobes_outside_the_limits_are_refused(archive: bytes, lobes: int) -> None:
    with pytest.raises(ValueError, match=f"lobes is {lobes}: ask for 1 to 8"):
        dataset_of(ArchivedMatte(io.BytesIO(archive)), lobes)


def test_lobes_that_are_not_a_whole_number_are_refused(archive: bytes) -> None:
    with pytest.raises(TypeError, match="integer"):
        dataset_of(ArchivedMatte(io.BytesIO(archive)), 2.5)  # type: ignore[arg-type]


def test_what_is_no_archive_of_a_matte_is_refused_in_words(archive: bytes) -> None:
    with pytest.raises(ArchiveError, match="not a ZIP archive, or it is cut off"):
        ArchivedMatte(io.BytesIO(archive[: len(archive) // 2]))
    with pytest.raises(ArchiveError, match=r"envmatte\.json: it is not in the archive"):
        ArchivedMatte(io.BytesIO(packed({"notes.txt": b"no matte"})))
    with pytest.raises(ArchiveError, match="this is a capture archive: upload it"):
        ArchivedMatte(io.BytesIO(packed({"capture.json": b"{}"})))


def test_damage_is_found_where_it_is_read(archive: bytes) -> None:
    files = unpacked(archive)
    chunk = bytearray(files["S/c/1/0/0"])
    chunk[len(chunk) // 2] ^= 1
    found = dataset_of(ArchivedMatte(io.BytesIO(packed(files | {"S/c/1/0/0": bytes(chunk)}))))
    found.S.isel(y=0, x=0).compute()
    with pytest.raises(ArchiveError, match="S/c/1/0/0: its checksum"):
        found.S.compute()
