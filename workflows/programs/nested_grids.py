"""Grids that nest, each a whole multiple of the one before, and the light of patterns on their cells."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.images.resample import on_grid
from workflows.recovery.sensing import Level, Sensing

Grid = tuple[int, int]
"""Columns and rows."""


class Shape(NamedTuple):
    """The grid on which a pattern is exact, its channels, and whether it is rolled off that grid."""

    columns: int
    rows: int
    channels: int
    offset: bool = False


def nested(grids: set[Grid]) -> list[Grid]:
    """Sort grids from coarse to fine, each a whole multiple of the one before.

    Raises
    ------
    OptionError
        If they do not nest.
    """
    ordered = _by_cells(grids)
    for coarse, fine in pairwise(ordered):
        if not _splits(coarse, fine):
            raise OptionError(
                f"the program's grids {coarse[0]} x {coarse[1]} and {fine[0]} x {fine[1]} do not nest: "
                "recovery goes from coarse to fine by splitting cells, so each grid must be a whole "
                "multiple of the one before",
                field="program",
            )
    return ordered


def chain(grids: set[Grid]) -> list[Grid]:
    """The longest chain of nested grids, from coarse to fine, that ends with the finest of all."""
    chains: dict[Grid, list[Grid]] = {}
    for grid in _by_cells(grids):
        below = (chains[coarse] for coarse in chains if _splits(coarse, grid))
        chains[grid] = [*max(below, key=len, default=[]), grid]
    return list(chains.values())[-1] if chains else []


def fitting(grids: list[Grid], cell: int, limit: int) -> list[Grid]:
    """Leave out the finest grids that do not fit into ``limit`` bytes, at ``cell`` bytes a cell.

    Raises
    ------
    OptionError
        If the coarsest alone takes more than ``limit`` bytes.
    """
    sizes = np.cumsum([cell * columns * rows for columns, rows in grids])
    if sizes[0] > limit:
        raise OptionError(
            f"the program's sensing matrices would take {sizes[0]} bytes, more than {limit}: "
            "use coarser grids or fewer patterns",
            field="program",
            limit=limit,
        )
    return grids[: int(np.count_nonzero(sizes <= limit))]


def sense(light: Iterable[NDArray[np.float32]], shapes: Sequence[Shape], grids: Sequence[Grid]) -> Sensing:
    """Build the sensing matrix of each grid: the light of patterns on its cells.

    Parameters
    ----------
    light : iterable of (rows, columns, 1 or 3) float32
        Linear light of each pattern, on its grid or, with an offset, on the finest of the grids.
    shapes : sequence of Shape
        The shape of each pattern.
    grids : sequence of (int, int)
        From coarse to fine, each a whole multiple of the one before. Those coarser than every pattern are left out:
        nothing could be solved on them.
    """
    first = np.array([_first_level(shape, grids) for shape in shapes])
    grids, first = grids[first.min() :], first - first.min()
    channels = max(shape.channels for shape in shapes)
    levels = []
    for at, (columns, rows) in enumerate(grids):
        usable = np.flatnonzero(first <= at)
        levels.append(
            Level(columns, rows, usable, np.empty((channels, rows * columns, usable.size), np.float32))
        )
    for pattern, shown in enumerate(light):
        for level in reversed(levels[first[pattern] :]):
            cells = on_grid(shown, level.columns, level.rows)
            column = np.searchsorted(level.patterns, pattern)
            level.light[:, :, column] = cells.reshape(-1, cells.shape[2]).T
            if cells.size < shown.size:
                shown = cells  # coarser cells are means of these: the same result, and faster
    return Sensing(tuple(levels))


def _by_cells(grids: set[Grid]) -> list[Grid]:
    return sorted(grids, key=lambda grid: (grid[0] * grid[1], grid))


def _splits(coarse: Grid, fine: Grid) -> bool:
    return fine[0] % coarse[0] == 0 and fine[1] % coarse[1] == 0


def _first_level(shape: Shape, grids: Sequence[Grid]) -> int:
    """Index of the coarsest grid on which a pattern is exact, or nearly so with an offset; else of the finest grid."""
    for at, (columns, rows) in enumerate(grids):
        if shape.offset and columns >= shape.columns and rows >= shape.rows:
            return at
        if not shape.offset and _splits((shape.columns, shape.rows), (columns, rows)):
            return at
    return len(grids) - 1
