"""When the search for shifts and gains ends, and which of them it believes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.ingest.trial.search import ROUNDS, Search, are_believed
from workflows.ingest.trial.trial_recovery import Trial

OFF = np.random.default_rng(0).normal(0, 0.1, (20, 3))
ALL = np.ones(20, bool)


@pytest.mark.parametrize(("with_gains", "rounds"), [(True, 2), (False, 1)])
def test_rounds_end_when_what_is_searched_for_has_settled(with_gains: bool, rounds: int) -> None:
    tried: list[NDArray[np.float64]] = []

    def again(state: NDArray[np.float64]) -> Trial:
        tried.append(state)
        gain = 0.1 if len(tried) == 1 else 0
        return Trial(OFF * [0.001, 0.001, gain], np.ones_like(OFF), 1.0)

    first = Trial(OFF, np.ones_like(OFF), 2.0)
    Search(again, np.zeros_like(OFF), ALL, with_gains).settle(first)
    assert len(tried) == rounds


@pytest.mark.parametrize(
    ("left", "best"),
    [
        ([2.1, 2.0], 1),
        ([1.6, 1.3, 1.2, 1.3, 1.25], 2),
        ([1.9, 2.1, 1.8, 1.797, 1.796], 4),
        ((2 * 0.99 ** np.arange(1, ROUNDS + 1)).tolist(), ROUNDS - 1),
    ],
)
def test_where_nothing_settles_rounds_end_when_they_explain_no_more_and_the_best_counts(
    left: list[float], best: int
) -> None:
    tried: list[NDArray[np.float64]] = []

    def again(state: NDArray[np.float64]) -> Trial:
        tried.append(state)
        # turned, so that what is left is no multiple of what was found
        return Trial(np.roll(OFF, len(tried), axis=0), np.ones_like(OFF), left[len(tried) - 1])

    first = Trial(OFF, np.ones_like(OFF), 2.0)
    state, trial, _ = Search(again, np.zeros_like(OFF), ALL, True).settle(first)
    assert len(tried) == len(left)
    assert trial.residual == left[best]
    assert state is tried[best]


@pytest.mark.parametrize(
    ("before", "after", "believed"),
    [
        (3.0, 1.2, [True, True]),
        (4.0, 2.0, [True, False]),  # gains explain more than shifts
        (1.5, 1.4, [False, False]),  # most is left
        (1.09, 1.04, [True, True]),  # half is left, but of nothing
    ],
)
def test_corrections_that_explain_the_frames_are_believed(
    before: float, after: float, believed: list[bool]
) -> None:
    assert are_believed(before, after).tolist() == believed
