"""Search for the shift and the gain of each frame, round by round, and judge whether they are certain."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.ingest.pixel_sample import FURTHEST, Doubles
from workflows.ingest.trial.movement import smooth_path
from workflows.ingest.trial.trial_recovery import WHITE_APART, Trial

ROUNDS = 10
"""Rounds of measuring and correcting, at most."""
SETTLED = (0.003, 0.0005)
"""Rounds end when shifts, in pixels, and gains change less than this, root mean square."""
MIN_DRIFT, MIN_FLICKER = 0.01, 0.003
"""Drift (root mean square, pixels) and flicker (standard deviation of the gain) below these are not corrected."""
TRIFLE = 0.5
"""The first trial sees only part of a disturbance: more rounds follow if it finds this share of `MIN_DRIFT` or
`MIN_FLICKER`,"""
LOOK_AGAIN, SURE = 2.0, 4.0
"""and at least `LOOK_AGAIN` standard errors. In the end, what is below `SURE` standard errors is not corrected."""
LIMITS = np.array([FURTHEST, FURTHEST, 0.4])
"""Largest shifts, in pixels, and largest logarithm of the gain that are searched for."""
REST = 0.25
"""The last round may leave at most this share of what was found."""
EXPLAINED = np.array([2.4, 1.5])
"""Largest residuals with which shifts and gains are believed, in standard deviations of the noise."""
STALLED = 0.005
"""Rounds end, too, when two in succession lower the squared residual by less than this share: they wander."""
LEFT = 0.4
"""The squared residual may keep this share of its excess over noise. If it keeps more, the frames differ from what is
predicted in ways that only look like shifts and gains."""
NOTHING_LEFT = 0.1
"""An excess of the squared residual over noise that is as good as none."""
MEMORY = 4
"""Rounds before the last one from which the next is extrapolated."""


class Found(NamedTuple):
    """What a search has found.

    Attributes
    ----------
    off : (frames, 3) float64
        Shifts and logarithms of gains.
    trial : Trial
        That they are of.
    moves, flickers : bool
        Whether shifts, and gains, are to be corrected.
    is_known : bool
        False if the patterns don't explain what the frames show.
    """

    off: Doubles
    trial: Trial
    moves: bool
    flickers: bool
    is_known: bool

    def to_correct(self, begin: Doubles) -> Doubles:
        """Shifts and logarithms of gains to correct, (frames, 3); gains are those of the beginning if there is no
        flicker.
        """
        gains = self.off if self.flickers else begin
        return np.concatenate([self.off[:, :2] * self.moves, gains[:, 2:]], axis=1)


class Search(NamedTuple):
    """A search for shifts and gains.

    Attributes
    ----------
    try_out : callable
        Tries shifts and logarithms of gains, (frames, 3) float64; None if there is too little contrast.
    begin : (frames, 3) float64
        Where it begins.
    shown : (frames,) bool
        The frames of patterns.
    with_gains : bool
        Whether gains are searched for too.
    """

    try_out: Callable[[Doubles], Trial | None]
    begin: Doubles
    shown: NDArray[np.bool_]
    with_gains: bool

    def run(self, first: Trial, residual: float) -> Found:
        """Search, given the trial of the beginning, and the residual without shifts and gains."""
        at_first, least = self.begin + _fill_gaps(first, self.shown), np.array([MIN_DRIFT, MIN_FLICKER])
        size, error = sizes_of(at_first - self.begin, first, self.shown)
        if not ((size > TRIFLE * least) & (size > LOOK_AGAIN * error)).any():
            is_known = bool(first.residual <= EXPLAINED[0])
            return Found(at_first, first, moves=False, flickers=False, is_known=is_known)
        found, last, left = self.settle(first)
        size, error = sizes_of(found - self.begin, last, self.shown)
        there = (size >= least) & (size >= SURE * error)
        sure = there & (sizes_of(left, last, self.shown)[0] <= REST * size) & are_within(found, self.shown)
        believed = are_believed(residual, last.residual)
        moves = bool(sure[0] and believed[0])
        # Movement that is not a common shift looks like flicker.
        flickers = bool(sure[1] and believed[1] and self.with_gains and (moves or not there[0]))
        if moves or flickers:
            return Found(found, last, moves, flickers, is_known=True)
        is_known = bool(last.residual <= EXPLAINED[0] and believed.any())
        # The first trial underestimates, but later rounds may have diverged.
        return Found(at_first, first, moves, flickers, is_known)

    def settle(self, trial: Trial) -> tuple[Doubles, Trial, Doubles]:
        """Correct and measure again, from the trial of the beginning, until little is left; returns what was found,
        the trial of it, and what that left.

        Where more is left whatever is done, later rounds wander: then it is the round that explains the frames best.
        """
        scale = np.array([1, 1, SETTLED[0] / SETTLED[1]])
        state, left = self.begin, self._left_by(trial)
        states: list[Doubles] = []
        steps: list[Doubles] = []
        tried: list[tuple[Doubles, Trial]] = []
        least = [trial.residual**2]
        for _ in range(ROUNDS):
            states.append(state * scale)
            steps.append(left * scale)
            ahead = _extrapolated(states, steps) / scale
            ahead[:, :2] -= ahead[self.shown, :2].mean(axis=0)
            ahead = np.clip(ahead, -LIMITS, LIMITS)
            again = self.try_out(ahead)
            if again is None:
                break
            state, trial = ahead, again
            left = self._left_by(trial)
            still = size_of(left[self.shown, :2]) < SETTLED[0] and size_of(left[self.shown, 2:]) < SETTLED[1]
            if still and not constants_apart(left, trial, self.shown):
                return state, trial, left
            tried.append((state, trial))
            least.append(min(least[-1], trial.residual**2))
            if len(tried) > 1 and least[-1] > (1 - STALLED) * least[-3]:
                break
        state, trial = min(tried, key=lambda one: one[1].residual, default=(state, trial))
        return state, trial, self._left_by(trial)

    def _left_by(self, trial: Trial) -> Doubles:
        """The shifts and gains that a trial leaves to find, (frames, 3)."""
        left: Doubles = _fill_gaps(trial, self.shown) * [1, 1, int(self.with_gains)]
        return left


def _extrapolated(states: list[Doubles], steps: list[Doubles]) -> Doubles:
    """The state that the last few states, and the step that followed from each, lead to.

    References
    ----------
    H. F. Walker and P. Ni, Anderson acceleration for fixed-point iterations, SIAM J. Numer. Anal. 49, 2011.
    """
    ahead: Doubles = states[-1] + steps[-1]
    if len(steps) > 1:
        from_steps, from_states = (
            np.diff(np.array(kept[-MEMORY - 1 :]).reshape(-1, ahead.size), axis=0).T
            for kept in (steps, states)
        )
        share = np.linalg.lstsq(from_steps, steps[-1].ravel(), rcond=None)[0]
        ahead -= ((from_steps + from_states) @ share).reshape(ahead.shape)
    return ahead


def are_believed(before: float, after: float) -> NDArray[np.bool_]:
    """Whether shifts and gains are believed, by the residuals before and after they were taken out."""
    left = max(LEFT * (before**2 - 1), NOTHING_LEFT)
    believed: NDArray[np.bool_] = (after < EXPLAINED) & (after**2 - 1 <= left)
    return believed


def _fill_gaps(trial: Trial, shown: NDArray[np.bool_]) -> Doubles:
    """The shift and gain of each frame; missing shifts are interpolated from other frames, missing gains are 1.

    Shifts are those of a likely path, relative to the mean position of the patterns, gains to those of the constant
    frames.
    """
    filled = trial.off.copy()
    known = np.flatnonzero(shown & np.isfinite(filled).all(axis=1))
    path = smooth_path(trial.off[known, :2], trial.error[known, :2])
    for axis in range(2):
        filled[:, axis] = np.interp(np.arange(len(filled)), known, path[:, axis])
    filled[:, :2] -= filled[shown, :2].mean(axis=0)
    return np.nan_to_num(filled)


def size_of(values: Doubles) -> float:
    """Root mean square of the lengths of rows."""
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def sizes_of(found: Doubles, trial: Trial, shown: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """Size of the drift and of the flicker, root mean square, and the standard errors of most frames.

    The flicker is that of patterns, or the difference between them and constant frames if that is larger.
    """
    error = trial.error[shown]
    flicker = max(float(found[shown, 2].std()), constants_apart(found, trial, shown))
    size = np.array([size_of(found[shown, :2]), flicker])
    return size, np.array([usual_error(error[:, :2]), usual_error(error[:, 2:])])


def constants_apart(found: Doubles, trial: Trial, shown: NDArray[np.bool_]) -> float:
    """By how much gains of constant frames differ from the mean of patterns', root mean square; 0 below
    `WHITE_APART`.

    All patterns are about as bright as each other, and white is twice as bright. So a monitor that limits its
    brightness, or an exposure that is not locked, may differ between white and patterns alone.
    """
    constant = ~shown & np.isfinite(trial.off[:, 2])
    if not constant.any():
        return 0.0
    apart = size_of((found[constant, 2] - found[shown, 2].mean())[:, np.newaxis])
    return apart if apart >= WHITE_APART else 0.0


def usual_error(errors: Doubles) -> float:
    """The median length of rows without gaps."""
    return float(np.median(np.linalg.norm(errors[np.isfinite(errors).all(axis=1)], axis=1)))


def are_within(found: Doubles, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether shifts and gains are within `LIMITS`."""
    most = np.abs(found[shown]).max(axis=0) < LIMITS
    return np.array([most[:2].all(), most[2]])
