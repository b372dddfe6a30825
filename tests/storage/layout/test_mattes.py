"""Mattes in the store: blocks in any order, any zarr reader, and missing files."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from obstore.exceptions import GenericError

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from tests.storage.layout.matte_blocks import block, extent, places, zeros

HEIGHT, WIDTH = 21, 40


def create(objects: Objects) -> Matte:
    return mattes.create(objects, "m", height=HEIGHT, width=WIDTH, columns=4, rows=3, method="none")


def fill(matte: Matte, order: list[tuple[int, int]]) -> None:
    for row, column in order:
        matte.write(row, column, block(*extent(matte, row, column), seed=10 * row + column))


def same(a: Block, b: Block) -> None:
    for name in ("S", "rho", "error", "recovered", "shared", "count", "cell", "weight"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)


@pytest.fixture
def matte(objects: Objects) -> Matte:
    made = create(objects)
    fill(made, places(made))
    return made


def test_matte_is_read_back(objects: Objects, matte: Matte) -> None:
    assert matte.missing() == set()
    again = Matte(objects, "m")
    assert (again.height, again.width, again.columns, again.rows, again.block) == (HEIGHT, WIDTH, 4, 3, 16)
    assert (again.block_rows, again.block_columns) == (2, 3)
    assert again.attributes["format"] == "envmatte-matte/1"
    assert again.attributes["method"] == "none"
    assert again.span(1, 2) == (slice(16, 21), slice(32, 40))
    for row, column in places(again):
        same(again.read(row, column), block(*extent(again, row, column), seed=10 * row + column))


def test_zarr_can_read_it(matte: Matte, folder: Path) -> None:
    group = zarr.open_group(str(folder / "mattes/m"), mode="r")
    expected = block(5, 8, seed=12)
    np.testing.assert_array_equal(group["S"][16:, 32:], expected.S)
    np.testing.assert_array_equal(group["recovered"][16:, 32:], expected.recovered)
    np.testing.assert_array_equal(group["shared"][16:, 32:], expected.shared)
    np.testing.assert_array_equal(group["T/1.2/cell"][:], expected.cell)
    np.testing.assert_array_equal(group["T/1.2/weight"][:], expected.weight)
    assert sorted(group["T"].group_keys()) == ["0.0", "0.1", "0.2", "1.0", "1.1", "1.2"]
    assert sorted(group["T/0.1"].array_keys()) == ["cell", "weight"]
    assert group["S"].metadata.dimension_names == ("y", "x", "channel")


def test_order_of_blocks_does_not_change_bytes(
    objects: Objects, matte: Matte, digests: Callable[[str], dict[str, str]]
) -> None:
    plain = digests("mattes/m")
    again = create(objects)
    order = places(again)
    again.write(*order[2], block(*extent(again, *order[2]), seed=99))
    fill(again, order[::-1] + order[2:4])
    assert digests("mattes/m") == plain


def test_block_of_zeros_is_stored(objects: Objects) -> None:
    matte = create(objects)
    for at, place in enumerate(places(matte)):
        matte.write(*place, zeros(*extent(matte, *place), entries=at % 2))
    assert matte.missing() == set()
    for at, place in enumerate(places(matte)):
        same(matte.read(*place), zeros(*extent(matte, *place), entries=at % 2))


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize(
    "file",
    [
        *("S/c/1/2/0", "rho/c/1/2/0", "count/c/1/2/0", "error/c/1/2", "recovered/c/1/2", "shared/c/1/2"),
        *("T/1.2/cell/c/0", "T/1.2/weight/c/0"),
    ],
)
def test_missing_file_is_corrupt(matte: Matte, folder: Path, objects: Objects, file: str, dark: bool) -> None:
    if dark:
        matte.write(1, 2, zeros(5, 8, entries=3))
    (folder / "mattes/m" / file).unlink()
    again = Matte(objects, "m")
    with pytest.raises(Corrupt):
        again.read(1, 2)
    assert again.missing() == {(1, 2)}
    same(again.read(0, 0), block(16, 16, seed=0))


@pytest.mark.parametrize("array", ["cell", "weight"])
def test_block_is_read_without_the_metadata_of_its_rows(
    matte: Matte, folder: Path, objects: Objects, array: str
) -> None:
    (folder / f"mattes/m/T/1.2/{array}/zarr.json").unlink()
    again = Matte(objects, "m")
    same(again.read(1, 2), block(5, 8, seed=12))
    assert again.missing() == {(1, 2)}


def test_block_that_was_never_written_is_corrupt(objects: Objects) -> None:
    matte = create(objects)
    fill(matte, places(matte)[:-1])
    matte.read(0, 0)
    with pytest.raises(Corrupt):
        matte.read(1, 2)
    assert matte.missing() == {(1, 2)}


def test_block_with_wrong_counts_is_corrupt(matte: Matte) -> None:
    good = block(16, 16, seed=5)
    cut = replace(good, cell=good.cell[:-1], weight=good.weight[:-1])
    matte.write(0, 1, cut)
    with pytest.raises(Corrupt, match=r"block 0\.1"):
        matte.read(0, 1)


def test_creating_matte_again_keeps_blocks(
    objects: Objects, matte: Matte, digests: Callable[[str], dict[str, str]]
) -> None:
    before = digests("mattes/m")
    create(objects)
    assert digests("mattes/m") == before


@pytest.mark.parametrize("array", ["S", "count", "shared"])
def test_matte_without_an_array_is_corrupt(objects: Objects, matte: Matte, folder: Path, array: str) -> None:
    (folder / "mattes/m" / array / "zarr.json").unlink()
    with pytest.raises(Corrupt, match="matte m"):
        Matte(objects, "m")


def test_counts_are_written_last(objects: Objects, folder: Path) -> None:
    matte = create(objects)
    (folder / "mattes/m/rho/c").write_bytes(b"in the way")
    with pytest.raises(GenericError):
        matte.write(0, 0, block(16, 16, seed=0))
    assert (folder / "mattes/m/S/c/0/0/0").exists()
    assert not (folder / "mattes/m/count/c").exists()


def test_empty_block_replaces_one_with_rows(
    objects: Objects, matte: Matte, digests: Callable[[str], dict[str, str]]
) -> None:
    matte.write(0, 1, zeros(16, 16, entries=0))
    assert matte.missing() == set()
    same(matte.read(0, 1), zeros(16, 16, entries=0))
    again = digests("mattes/m")
    fresh = create(objects)
    for place in places(fresh):
        empty = place == (0, 1)
        extents = extent(fresh, *place)
        fresh.write(
            *place, zeros(*extents, entries=0) if empty else block(*extents, seed=10 * place[0] + place[1])
        )
    assert digests("mattes/m") == again


def test_missing_matte_is_corrupt(objects: Objects) -> None:
    with pytest.raises(Corrupt, match="matte none"):
        Matte(objects, "none")
