"""Measure how much a camera brightens what is dark around a place, by what a trial recovery leaves unexplained."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.camera.border_exposure import BorderLight
from workflows.ingest.light.local_gain import DARK, DISPLAY, Surroundings, surroundings
from workflows.ingest.pixel_sample import Doubles, PixelSample
from workflows.ingest.trial.border_tone_mapping import Power, border_power
from workflows.ingest.trial.trial_recovery import HUBER
from workflows.ingest.trial.unexplained import DETAIL, MIN_FLAT, SEEN, Rest
from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA

WIDTHS = (1 / 40, 1 / 20, 1 / 10)
"""Widths of the surroundings that are tried, as shares of the frame's width,"""
NARROWEST = 6.0
"""unless they are narrower than this, in pixels: sharpening would look alike."""
SHARPENED = 3
"""How far sharpening, denoising and compression reach, in pixels: what follows the light so near is theirs."""
SURE = 5.0
"""A power is real from so many standard errors on,"""
LEAST = 0.02
"""and a smaller one is left out: it changes light by less than 3 %."""
MOST = 1.0
"""A larger one is something else: with this one, a place would be as bright whatever the light around it."""
MIDDLE = 0.125**DISPLAY
"""Brightness of surroundings that have a gain of 1: those for which light meters expose (ISO 2720, K = 12.5)."""
REWEIGHTED, SWEEPS = 5, 8
"""How often weights are updated, and sweeps over what is free at each update."""
SPREAD = 0.01
"""Errors that are in proportion to the light, at least, as a share of it."""


def find_tone_mapping(
    stack: Stack,
    rest: Rest,
    sample: PixelSample,
    known: dict[str, float] | None,
    border: BorderLight | None = None,
) -> dict[str, float] | None:
    """The local tone mapping that a sample of the pixels, or a border, shows; None if it is not certain, a trifle, or
    more than any.

    Parameters
    ----------
    stack : Stack
    rest : Rest
        What the recovery of the sample leaves unexplained.
    sample : PixelSample
    known : dict, optional
        What was found, and corrected, before: the rest is added to it.
    border : BorderLight, optional
        Of a film. Its power counts if its standard error is the smaller one.

    Returns
    -------
    dict or None
        ``power``; ``width`` of the surroundings, as a share of the frame's width; ``usual``, the logarithm of their
        brightness, plus `workflows.ingest.light.local_gain.DARK`, that has a gain of 1; and ``spread``, the standard
        deviation of the logarithm.

    Notes
    -----
    A camera that multiplies light by ``m^-p``, m the brightness around a place, makes of the predicted value C one that
    is larger by ``-p log(m) C``. Where a pixel sees a pattern as all black or all white, there is no error of T's place
    or shape that could look alike, and the values of one pixel are alike too, so that no error of the camera's curve
    does. Of the residuals there, each pixel's mean and each frame's gain are left free: S, rho and flicker are
    uncertain. Under patterns in colour, a channel is all black or all white while the others are not, and surroundings
    are the brighter, the brighter these are. So only values count of which all three channels are black or white, and
    what a channel sees of each of the others is left free too. T has explained some of the rest, so that what is found
    is corrected, and searched for once more. Sharpening makes a place the brighter, the darker the pixels beside it
    are, and these are bright where the surroundings are: in sharpened JPEG stills of clear glass, under patterns in
    colour, it alone looks like a power of 0.11 with a standard error of 0.006. So the power must be as certain beside
    amounts of the light in the rings of pixels around each, up to `SHARPENED`: in these stills it is then 0.00. Some
    local tone mapping follows them too, so that its size is the one without them. Glare makes a place that is bright
    around not darker but brighter. The border of a film has light that no T has to explain (`border_power`).
    """
    widths = [known["width"]] if known else [w for w in WIDTHS if w * stack.width >= NARROWEST]
    tried = [(width, near) for width in widths if (near := surroundings(stack, width)) is not None]
    flat = rest.flat & (np.abs(rest.plain) > SEEN).all(axis=1, keepdims=True)
    ways = [_power_of(rest, flat, sample)] if np.count_nonzero(flat) >= MIN_FLAT else []
    if border is not None:
        ways.append(partial(border_power, border))
    if not tried or not ways:
        return None
    by_way = [
        max(((way(near), width, near) for width, near in tried), key=lambda one: one[0].explained)
        for way in ways
    ]
    (power, error, _), width, near = min(by_way, key=lambda one: one[0].error)
    total = power + (known["power"] if known else 0.0)
    if total > MOST:
        return None
    if known:
        return known | {"power": max(total, 0.0)}
    if power < max(SURE * error, LEAST):
        return None
    spread = float(near.at(*sample.places).std())
    return {"power": power, "width": width, "usual": float(np.log(MIDDLE + DARK)), "spread": spread}


def _power_of(rest: Rest, at: NDArray[np.bool_], sample: PixelSample) -> Callable[[Surroundings], Power]:
    """A function from surroundings to the power that some residuals of a sample, (n, channels, m), show."""
    pixel, channel, shown = np.nonzero(at)
    frame = rest.frames[shown]
    level, value = rest.level[at], (rest.rest * rest.rho)[at] / 2
    detail = DETAIL * np.maximum(1 - rest.plain[at] ** 2, 0) * (rest.rho[at] / 2) ** 2
    weight = 1 / np.sqrt(rest.noise.variance(level) + (SPREAD * level) ** 2 + detail)
    group = 2 * (pixel * at.shape[1] + channel) + (rest.plain[at] > 0)
    free = [(group, weight), (shown, weight * level)]
    for further in range(1, at.shape[1]):
        other = (channel + further) % at.shape[1]
        # Cameras clip what is less than black: a channel that is black sees another one differently.
        pair = 2 * (channel * at.shape[1] + other) + (rest.plain[at] > 0)
        free.append((pair, weight * rest.rho[at] * rest.plain[pixel, other, shown]))
    clusters = [sample.chosen[0][pixel], shown]
    beside = [ring[frame, pixel] * level * weight for ring in sample.rings(SHARPENED)]

    def power(near: Surroundings) -> Power:
        around = near.at(*sample.places)
        column = -(around[frame, pixel] - around.mean()) * level * weight
        found = _fit([column], value * weight, free, clusters)
        left = _fit([column, *beside], value * weight, free, clusters)
        share = left.error / left.power if left.power > 0 else np.inf
        return found._replace(error=max(found.error, abs(found.power) * share))

    return power


def _fit(
    columns: Sequence[NDArray[np.floating]],
    value: NDArray[np.floating],
    free: Sequence[tuple[NDArray[np.intp], NDArray[np.floating]]],
    clusters: Sequence[NDArray[np.intp]],
) -> Power:
    """Robust least squares of columns to values, with an amount of each free column in each of its groups.

    The power is the amount of the first column.
    """
    groups = [np.ascontiguousarray(group) for group, _ in free]
    freed = [np.ascontiguousarray(column, np.float64) for _, column in free]
    trust = np.ones(len(value))
    for _ in range(REWEIGHTED):
        totals = [np.maximum(np.bincount(group, trust * column**2), 1e-20) for group, column in free]
        *cleared, r = (v.astype(np.float64) for v in (*columns, value))
        for v in (*cleared, r):
            for _ in range(SWEEPS):
                for of_free in zip(groups, freed, totals, strict=True):
                    _take_out(v, trust, *of_free)
        A = np.stack(cleared, axis=1)
        inverse = np.linalg.pinv((A * trust[:, np.newaxis]).T @ A)
        found = inverse @ (A.T @ (trust * r))
        left = r - A @ found
        scale = max(MEDIAN_TO_SIGMA * float(np.median(np.abs(left))), 1e-12)
        trust = np.minimum(1, HUBER * scale / np.maximum(np.abs(left), 1e-12))
    power, own = float(found[0]), A @ inverse[0]
    # Pixels beside each other, and those of a frame, are not independent.
    pulls = [np.bincount(cluster, trust * own * left) for cluster in clusters]
    error = max(float(np.sqrt((pull**2).sum())) for pull in pulls)
    return Power(power, error, power**2 / max(inverse[0, 0], 1e-20) / scale**2 if power > 0 else 0.0)


@njit(
    "void(float64[::1], float64[::1], int64[::1], float64[::1], float64[::1])",
    nogil=True,
    cache=True,
)
def _take_out(
    values: Doubles, weight: Doubles, group: NDArray[np.int64], column: Doubles, total: Doubles
) -> None:
    """Take out of values the amount of a column that each of its groups has, by weighted least squares.

    ``total`` is the weighted sum of the column's squares in each group.
    """
    amount = np.zeros(len(total))
    for n in range(len(values)):
        amount[group[n]] += weight[n] * values[n] * column[n]
    amount /= total
    for n in range(len(values)):
        values[n] -= amount[group[n]] * column[n]
