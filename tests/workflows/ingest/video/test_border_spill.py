"""The cells of a border are distinguished from those of patterns by what they follow."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.ingest.video.border_spill import without_border
from workflows.programs.border import BITS, TICKS, number_cells, tick_cells
from workflows.programs.presets import preset

ROWS, COLUMNS = 12, 16


def looks(count: int, bordered: bool) -> dict[int, NDArray[np.float64]]:
    """Cells of random light; if asked for, the outermost show mixtures of a border's."""
    random = np.random.Generator(np.random.PCG64(1))
    edge = np.ones((ROWS, COLUMNS), bool)
    edge[1:-1, 1:-1] = False
    mixture = random.random((np.count_nonzero(edge), 2 * (BITS + 1) + 2 * TICKS)) ** 8
    seen = {}
    for number in range(count):
        look = random.random((ROWS, COLUMNS, 3))
        if bordered:
            lit = np.concatenate([number_cells(number), tick_cells(number)])
            look[edge] = (mixture @ lit)[:, None] + 0.1 * random.standard_normal((len(mixture), 3))
        seen[number] = look
    return seen


@pytest.mark.parametrize("name", ["default", "quick", "sketch"])
def test_cells_that_follow_the_numbers_are_left_out(name: str) -> None:
    program = preset(name)
    seen = looks(program.count, bordered=True)
    left = without_border(program, seen)
    assert left.keys() == seen.keys()
    for number, look in seen.items():
        np.testing.assert_array_equal(left[number], look[1:-1, 1:-1].reshape(-1, 3))


@pytest.mark.parametrize(("count", "bordered"), [(132, False), (10, True), (4, True), (0, True)])
def test_all_cells_are_kept_without_a_border_or_enough_patterns(count: int, bordered: bool) -> None:
    seen = looks(count, bordered)
    left = without_border(preset("default"), seen)
    assert left.keys() == seen.keys()
    for number, look in seen.items():
        np.testing.assert_array_equal(left[number], look.reshape(-1, 3))


def test_all_cells_are_kept_if_only_the_border_is_visible() -> None:
    seen = {number: look[:1] for number, look in looks(132, bordered=True).items()}
    assert without_border(preset("default"), seen)[5].shape == (COLUMNS, 3)
