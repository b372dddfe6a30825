import numpy as np
import pytest

from workflows.recovery.transport import Transport, ragged_entries


@pytest.fixture
def transport():
    count = np.array([[2, 0, 1], [1, 1, 3]])
    cell = np.array([0, 5, 2, 1, 3, 0, 4, 5])
    weight = np.array([1, 3, 2, 1, 1, 0.5, 0.25, 0.25])
    return Transport.from_rows(3, 2, count, cell, weight)


def dense(transport):
    out = np.zeros((*transport.count.shape, transport.rows * transport.columns))
    row = np.repeat(np.arange(out.shape[0] * 3), transport.count.ravel())
    out.reshape(-1, out.shape[2])[row, transport.cell] = transport.weight
    return out


def test_rows_sum_to_one(transport):
    np.testing.assert_allclose(dense(transport).sum(2), [[1, 0, 1], [1, 1, 1]], rtol=1e-6)
    np.testing.assert_array_equal(dense(transport)[0, 0], [0.25, 0, 0, 0, 0, 0.75])
    assert (transport.count.dtype, transport.cell.dtype, transport.weight.dtype) == (
        np.uint32,
        np.uint32,
        np.float32,
    )


def test_tiny_entries_are_dropped_and_empty_rows_stay_empty():
    made = Transport.from_rows(2, 1, np.array([[2, 1, 0]]), np.array([0, 1, 0]), np.array([1, 5e-5, 0]))
    np.testing.assert_array_equal(made.count, [[1, 0, 0]])
    np.testing.assert_array_equal(made.weight, [1])


@pytest.mark.parametrize(
    ("cell", "weight", "message"),
    [
        ([0, 1, 0], [1, 1], "count"),
        ([1, 0], [1, 1], "ascend"),
        ([0, 1], [1, -1], "negative"),
        ([0, 1], [1, np.nan], "finite"),
    ],
)
def test_malformed_rows_are_refused(cell, weight, message):
    with pytest.raises(ValueError, match=message):
        Transport.from_rows(2, 1, np.array([[2, 0, 0]]), np.array(cell), np.array(weight, float))


def test_concatenate_joins_pixels_in_order(transport):
    joined = Transport.concatenate([transport, transport])
    np.testing.assert_array_equal(dense(joined), np.concatenate([dense(transport)] * 2))


def test_concatenate_refuses_different_grids(transport):
    other = Transport(2, 3, transport.count, transport.cell, transport.weight, transport.shared)
    with pytest.raises(ValueError, match="same grid"):
        Transport.concatenate([transport, other])
    with pytest.raises(ValueError, match="same grid"):
        Transport.concatenate([])


def test_apply_is_the_matrix_product(transport):
    light = np.random.default_rng(0).random((6, 3)).astype(np.float32)
    expected = np.einsum("nci,ic->nc", dense(transport), light)
    np.testing.assert_allclose(transport.apply(light), expected, rtol=1e-6)
    with pytest.raises(ValueError, match="light"):
        transport.apply(light[:5])


def test_a_shared_row_serves_all_channels():
    count = np.array([[2, 0, 0], [1, 1, 1], [0, 0, 0]])
    cell, weight = np.array([0, 7, 1, 2, 3]), np.array([0.5, 0.5, 1, 1, 1])
    made = Transport.from_rows(3, 2, count, cell, weight, np.array([True, False, True]))
    # nodes beyond the first grid's six are allowed for
    light = np.random.default_rng(0).random((8, 3)).astype(np.float32)
    expected = [(light[0] + light[7]) / 2, [light[1, 0], light[2, 1], light[3, 2]], [0, 0, 0]]
    np.testing.assert_allclose(made.apply(light), expected, rtol=1e-6)
    with pytest.raises(ValueError, match="light"):
        made.apply(light[:7])
    joined = Transport.concatenate([made, made])
    np.testing.assert_array_equal(joined.shared, [True, False, True] * 2)
    np.testing.assert_allclose(joined.apply(light), expected * 2, rtol=1e-6)


def test_an_entry_is_dropped_by_its_share_of_the_row():
    count, cell, weight = np.array([[3, 0, 0]]), np.array([0, 1, 2]), np.array([1.0, 1.0, 0.02])
    kept = Transport.from_rows(3, 1, count, cell, weight, least_weight=0.009)
    assert kept.count[0, 0] == 3
    dropped = Transport.from_rows(3, 1, count, cell, weight, least_weight=0.011)
    np.testing.assert_array_equal(dropped.weight, [0.5, 0.5])


def test_ragged_entries_of_no_runs():
    assert ragged_entries(np.array([], int), np.array([], int)).size == 0
