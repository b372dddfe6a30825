"""T as a few lookups a pixel."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.composite.live.lookups import fit_lookups
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport

COLUMNS, ROWS = 130, 70
PYRAMID = Pyramid.over(COLUMNS, ROWS)
Row = dict[int, float]


def node(level: int, row: int, column: int) -> int:
    return int(PYRAMID.starts[level]) + row * PYRAMID.grids[level][0] + column


def fit(*pixels: tuple[Row, ...], most: int = 4) -> NDArray[np.float32]:
    """The lookups of pixels, each of one row for all channels or of three."""
    count = np.zeros((len(pixels), 3), np.uint32)
    for n, rows in enumerate(pixels):
        count[n, : len(rows)] = [len(row) for row in rows]
    cell = np.array([one for rows in pixels for row in rows for one in row], np.uint32)
    weight = np.array([w for rows in pixels for row in rows for w in row.values()], np.float32)
    shared = np.array([len(rows) == 1 for rows in pixels])
    transport = Transport(COLUMNS, ROWS, count, cell, weight, shared)
    return fit_lookups(transport, most, np.ones(len(pixels), bool))


def random_row(seed: int, nodes: int) -> Row:
    rng = np.random.default_rng(seed)
    cells = rng.choice(PYRAMID.nodes, nodes, replace=False)
    weights = rng.random(nodes) + 0.1
    return dict(zip(cells.tolist(), (weights / weights.sum()).tolist(), strict=True))


@pytest.mark.parametrize("level", range(len(PYRAMID.grids)))
def test_a_node_is_looked_up_as_what_it_is(level: int) -> None:
    columns, rows = PYRAMID.grids[level]
    for row, column in ((0, 0), (rows // 2, columns // 3), (rows - 1, columns - 1)):
        (lookups,) = fit(({node(level, row, column): 1.0},))
        expected = [(column + 0.5) * 2**level, (row + 0.5) * 2**level, level, 1, 1, 1]
        np.testing.assert_allclose(lookups, [expected, *np.zeros((3, 6))], atol=1e-4)


def test_neighbours_are_one_lookup_between_them() -> None:
    (lookups,) = fit(({node(1, 4, 6): 0.25, node(1, 4, 7): 0.75},), most=1)
    np.testing.assert_allclose(lookups[0], [2 * 7.25, 2 * 4.5, 1, 1, 1, 1], atol=1e-4)


def test_what_is_wider_is_looked_up_further_up() -> None:
    square = {node(0, row, column): 1 / 64 for row in range(8, 16) for column in range(32, 40)}
    (lookups,) = fit((square,), most=1)
    # its variance is 64 / 12; half-way between nodes that of a lookup is 11 / 6 on level 1, and 47 / 6 on level 2
    np.testing.assert_allclose(lookups[0, :3], [36, 12, 1 + 3.5 / 6], atol=1e-4)


@pytest.mark.parametrize("nodes", [3, 20, 200])
@pytest.mark.parametrize("most", [1, 4])
def test_all_light_is_kept_where_it_was_heaviest_first(nodes: int, most: int) -> None:
    row = random_row(nodes, nodes)
    (lookups,) = fit((row,), most=most)
    assert np.count_nonzero(lookups[:, 3]) == min(nodes, most)
    assert (np.diff(lookups[:, 3]) <= 0).all()
    np.testing.assert_array_equal(lookups[:, 3:4].repeat(3, axis=1), lookups[:, 3:])
    x, y = np.zeros((2, nodes))
    for n, cell in enumerate(row):
        level = int(np.searchsorted(PYRAMID.starts, cell, "right")) - 1
        down, across = divmod(cell - int(PYRAMID.starts[level]), PYRAMID.grids[level][0])
        x[n], y[n] = (across + 0.5) * 2**level, (down + 0.5) * 2**level
    weights = np.array(list(row.values()))
    np.testing.assert_allclose(lookups[:, 3].sum(), 1, atol=1e-5)
    np.testing.assert_allclose(lookups[:, 3] @ lookups[:, :2], [weights @ x, weights @ y], rtol=1e-4)


def test_channels_share_their_lookups() -> None:
    here, there = node(0, 5, 5), node(0, 60, 100)
    lookups, alone = fit(({here: 1.0}, {here: 0.5, there: 0.5}, {there: 1.0}), (random_row(3, 40),))
    assert [one.tolist() for one in lookups[:, 3:]] == [[1, 0.5, 0], [0, 0.5, 1], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_array_equal(alone, fit((random_row(3, 40),))[0])


def test_the_cheapest_mergers_come_first() -> None:
    row = random_row(5, 12)
    clusters = []
    for cell, w in row.items():
        level = int(np.searchsorted(PYRAMID.starts, cell, "right")) - 1
        down, across = divmod(cell - int(PYRAMID.starts[level]), PYRAMID.grids[level][0])
        clusters.append((w, w * (across + 0.5) * 2**level, w * (down + 0.5) * 2**level))

    def cost(a: tuple[float, ...], b: tuple[float, ...]) -> float:
        apart = (a[1] / a[0] - b[1] / b[0]) ** 2 + (a[2] / a[0] - b[2] / b[0]) ** 2
        return a[0] * b[0] / (a[0] + b[0]) * apart

    while len(clusters) > 4:
        pairs = [(cost(a, b), i, j) for i, a in enumerate(clusters) for j, b in enumerate(clusters[:i])]
        _, i, j = min(pairs)
        merged = tuple(np.add(clusters[i], clusters[j]))
        clusters = [one for n, one in enumerate(clusters) if n not in (i, j)] + [merged]
    expected = sorted(([x / w, y / w, w] for w, x, y in clusters), key=lambda one: -one[2])
    np.testing.assert_allclose(fit((row,))[0][:, [0, 1, 3]], expected, rtol=1e-4)


def test_what_is_not_wanted_is_left_out() -> None:
    row = random_row(1, 9)
    count = np.array([[9, 0, 0]] * 2, np.uint32)
    given = np.array([*row, *row], np.uint32), np.array([*row.values()] * 2, np.float32), np.ones(2, bool)
    lookups = fit_lookups(Transport(COLUMNS, ROWS, count, *given), 4, np.array([False, True]))
    assert not lookups[0].any()
    np.testing.assert_array_equal(lookups[1], fit((row,))[0])


def test_pixel_of_more_nodes_than_are_held_keeps_its_light() -> None:
    side = 400
    cell = np.sort(np.random.default_rng(2).choice(side * side, 50_000, replace=False)).astype(np.uint32)
    count, shared = np.array([[cell.size, 0, 0]], np.uint32), np.array([True])
    weight = np.full(cell.size, 1 / cell.size, np.float32)
    transport = Transport(side, side, count, cell, weight, shared)
    found = fit_lookups(transport, 4, np.array([True]))[0].astype(np.float64)
    np.testing.assert_allclose(found[:, 3:].sum(axis=0), 1, atol=1e-4)
    np.testing.assert_allclose(found[:, 3] @ found[:, 0], (cell % side + 0.5).mean(), rtol=1e-4)
    np.testing.assert_allclose(found[:, 3] @ found[:, 1], (cell // side + 0.5).mean(), rtol=1e-4)
