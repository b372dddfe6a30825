"""A matte in the store: blocks whatever the order of writing, damage that is found, and its record."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from obstore.exceptions import GenericError
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.errors import Corrupt, NotFound
from storage.layout import mattes as stored_mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from storage.records import mattes

HEIGHT, WIDTH = 21, 40
CELLS = 12


def block(height: int, width: int, seed: int) -> Block:
    rng = np.random.default_rng(seed)
    recovered = rng.random((height, width)) < 0.8
    count = rng.integers(0, 4, (height, width, 3), np.uint32) * recovered[..., None]
    entries = int(count.sum())
    return Block(
        rng.random((height, width, 3), np.float32),
        rng.random((height, width, 3), np.float32),
        rng.random((height, width), np.float32),
        recovered,
        rng.random((height, width)) < 0.5,
        count.astype(np.uint32),
        rng.integers(0, CELLS, entries, np.uint32),
        rng.random(entries, np.float32),
    )


def zeros(height: int, width: int, entries: int) -> Block:
    """A block of nothing but zeros, with rows all at cell 0 or with none."""
    light = np.zeros((height, width, 3), np.float32)
    count = np.zeros((height, width, 3), np.uint32)
    count[0, 0, 0] = entries
    cell, weight = np.zeros(entries, np.uint32), np.zeros(entries, np.float32)
    nowhere = np.zeros((height, width), bool)
    return Block(light, light, light[..., 0], nowhere, nowhere, count, cell, weight)


def create(objects: Objects) -> Matte:
    return stored_mattes.create(objects, "m", height=HEIGHT, width=WIDTH, columns=4, rows=3, method="none")


def places(matte: Matte) -> list[tuple[int, int]]:
    return [(row, column) for row in range(matte.block_rows) for column in range(matte.block_columns)]


def extent(matte: Matte, row: int, column: int) -> tuple[int, int]:
    y, x = matte.span(row, column)
    return y.stop - y.start, x.stop - x.start


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


def test_a_matte_comes_back(objects: Objects, matte: Matte) -> None:
    assert matte.missing() == set()
    again = Matte(objects, "m")
    assert (again.height, again.width, again.columns, again.rows, again.block) == (HEIGHT, WIDTH, 4, 3, 16)
    assert (again.block_rows, again.block_columns) == (2, 3)
    assert again.attributes["format"] == "envmatte-matte/1"
    assert again.attributes["method"] == "none"
    assert again.span(1, 2) == (slice(16, 21), slice(32, 40))
    for row, column in places(again):
        same(again.read(row, column), block(*extent(again, row, column), seed=10 * row + column))


def test_any_zarr_reader_can_read_it(matte: Matte, folder: Path) -> None:
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


def test_blocks_in_any_order_and_again_are_the_same_bytes(
    objects: Objects, matte: Matte, digests: Callable[[str], dict[str, str]]
) -> None:
    plain = digests("mattes/m")
    again = create(objects)
    order = places(again)
    again.write(*order[2], block(*extent(again, *order[2]), seed=99))
    fill(again, order[::-1] + order[2:4])
    assert digests("mattes/m") == plain


def test_zeros_are_stored_like_anything_else(objects: Objects) -> None:
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
        *("T/1.2/cell/c/0", "T/1.2/weight/c/0", "T/1.2/cell/zarr.json", "T/1.2/weight/zarr.json"),
    ],
)
def test_a_removed_file_is_corrupt(
    matte: Matte, folder: Path, objects: Objects, file: str, dark: bool
) -> None:
    if dark:
        matte.write(1, 2, zeros(5, 8, entries=3))
    (folder / "mattes/m" / file).unlink()
    again = Matte(objects, "m")
    with pytest.raises(Corrupt):
        again.read(1, 2)
    assert again.missing() == {(1, 2)}
    same(again.read(0, 0), block(16, 16, seed=0))


def test_a_block_that_was_never_written_is_corrupt(objects: Objects) -> None:
    matte = create(objects)
    fill(matte, places(matte)[:-1])
    matte.read(0, 0)
    with pytest.raises(Corrupt):
        matte.read(1, 2)
    assert matte.missing() == {(1, 2)}


def test_counts_that_do_not_fit_are_corrupt(matte: Matte) -> None:
    good = block(16, 16, seed=5)
    cut = replace(good, cell=good.cell[:-1], weight=good.weight[:-1])
    matte.write(0, 1, cut)
    with pytest.raises(Corrupt, match=r"block 0\.1"):
        matte.read(0, 1)


def test_a_matte_made_again_keeps_what_was_written(
    objects: Objects, matte: Matte, digests: Callable[[str], dict[str, str]]
) -> None:
    before = digests("mattes/m")
    create(objects)
    assert digests("mattes/m") == before


@pytest.mark.parametrize("array", ["S", "count", "shared"])
def test_a_matte_without_one_of_its_arrays_is_corrupt(
    objects: Objects, matte: Matte, folder: Path, array: str
) -> None:
    (folder / "mattes/m" / array / "zarr.json").unlink()
    with pytest.raises(Corrupt, match="matte m"):
        Matte(objects, "m")


def test_a_block_is_written_once_its_counts_are_there(objects: Objects, folder: Path) -> None:
    matte = create(objects)
    (folder / "mattes/m/rho/c").write_bytes(b"in the way")
    with pytest.raises(GenericError):
        matte.write(0, 0, block(16, 16, seed=0))
    assert (folder / "mattes/m/S/c/0/0/0").exists()
    assert not (folder / "mattes/m/count/c").exists()


def test_a_block_without_rows_takes_the_place_of_one_with_some(
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


def test_a_matte_that_is_not_there(objects: Objects) -> None:
    with pytest.raises(Corrupt, match="matte none"):
        Matte(objects, "none")


def test_the_record(engine: Engine) -> None:
    with writing(engine) as connection:
        mattes.add(connection, "m1", "c1", "j1", {"method": "lobes"})
        mattes.add(connection, "m2", "c1", "j2", {})
        row = mattes.get(connection, "m1")
        assert (row.state, row.capture, row.job, row.options) == (
            "recovering",
            "c1",
            "j1",
            {"method": "lobes"},
        )
        mattes.change(connection, "m1", state="ready", figures={"block": 16})
    with writing(engine) as connection:
        assert mattes.get(connection, "m1").figures == {"block": 16}
        assert mattes.get(connection, "m2").figures is None
        mattes.delete(connection, "m1")
        with pytest.raises(NotFound, match="'m1'"):
            mattes.get(connection, "m1")
        assert mattes.get(connection, "m2").state == "recovering"
