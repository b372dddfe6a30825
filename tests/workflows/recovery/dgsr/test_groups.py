import numpy as np
from scipy.ndimage import binary_dilation, convolve

from workflows.recovery.dgsr.groups import NEIGHBOUR_SHARE, Rows, group_sums
from workflows.recovery.sensing import Level

KERNEL = np.full((3, 3), NEIGHBOUR_SHARE)
KERNEL[1, 1] = 1


def level(columns, rows):
    return Level(columns, rows, np.arange(0), np.empty((1, columns * rows, 0), np.float32))


def rows_of(dense):
    """Rows of dense weights (n, cells)."""
    row, cell = np.nonzero(dense)
    begin = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(dense)))])
    return Rows(begin, cell.astype(np.int32), dense[row, cell].astype(np.float32))


def random_rows(n, columns, rows):
    rng = np.random.default_rng(columns)
    return np.where(rng.random((n, rows * columns)) < 0.1, rng.random((n, rows * columns)), 0)


def test_group_sums_are_a_convolution():
    dense = random_rows(1, 9, 7)
    rows = rows_of(dense)
    out, field = np.empty(rows.cell.size, np.float32), np.zeros((9, 11), np.float32)
    group_sums(rows.cell, rows.weight, 9, field, out)
    expected = convolve(dense.reshape(7, 9), KERNEL, mode="constant").ravel()[rows.cell]
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    assert (field == 0).all()


def test_split_prunes_widens_and_shares():
    dense = random_rows(20, 8, 6)
    split = rows_of(dense).split(level(8, 6), level(24, 12), 0.6, 1)
    for p in range(20):
        grid = dense[p].reshape(6, 8)
        kept = (grid > 0) & (convolve(grid, KERNEL, mode="constant") > 0.6)
        wide = binary_dilation(kept, np.ones((3, 3)))
        cells = np.flatnonzero(wide.repeat(2, 0).repeat(3, 1))
        entries = slice(split.begin[p], split.begin[p + 1])
        np.testing.assert_array_equal(split.cell[entries], cells)
        shares = (grid / 6).repeat(2, 0).repeat(3, 1).ravel()[cells]
        np.testing.assert_allclose(split.weight[entries], shares, rtol=1e-6)


def test_split_without_reach_keeps_only_children():
    dense = np.zeros((1, 12))
    dense[0, 5] = 1
    split = rows_of(dense).split(level(4, 3), level(8, 6), 0.0, 0)
    np.testing.assert_array_equal(split.cell, [18, 19, 26, 27])
    np.testing.assert_array_equal(split.weight, np.full(4, 0.25))


def test_split_of_many_cells_grows_its_buffers():
    dense = np.ones((3, 8 * 6))
    split = rows_of(dense).split(level(8, 6), level(64, 48), 0.0, 1)
    np.testing.assert_array_equal(split.cell, np.tile(np.arange(64 * 48), 3))


def test_take_repeats_and_reorders_rows():
    rows = rows_of(random_rows(4, 5, 5))
    taken = rows.take(np.array([2, 2, 0]))
    for i, p in enumerate((2, 2, 0)):
        expected = rows.cell[rows.begin[p] : rows.begin[p + 1]]
        np.testing.assert_array_equal(taken.cell[taken.begin[i] : taken.begin[i + 1]], expected)
    assert Rows.whole(2, level(3, 2)).take(np.array([], int)).cell.size == 0


def test_transport_gives_rows_to_channels():
    rows = rows_of(np.array([[0, 2.0, 2.0], [1.0, 0, 0]]))
    transport = rows.transport(level(3, 1), np.array([[0, 0, 1], [-1, 1, -1]]))
    np.testing.assert_array_equal(transport.count, [[2, 2, 1], [0, 1, 0]])
    np.testing.assert_array_equal(transport.cell, [1, 2, 1, 2, 0, 0])
    np.testing.assert_array_equal(transport.weight, [0.5, 0.5, 0.5, 0.5, 1, 1])
