"""The camera's tone curve, from half-tones: frames whose light is known although the monitor's curve is not."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.images.tone_curves import SAMPLES, CameraCurve, Curve, Sampled, to_light

KNOTS = 13
"""Knots of the curve."""
BINS = 40
"""Groups of values of about the same brightness, each of which gives an equation for each half-tone."""
MIN_CONTRAST = 0.05
"""Difference of the codes of white and black from which a value counts."""
MIN_VALUES = 400
"""Values that are needed,"""
REACH = 0.25
"""and the code that the brightest must reach."""
FURTHEST = 0.35
"""Largest error of a half-tone, of white's light, with which a value counts at first, when sRGB is assumed,"""
OUTLIER = 4.0
"""and then, times the median error."""
AGREES = 0.01
"""Error of half-tones, as a share of white, with which a named curve is right."""
LOST = {0.25: 0.087, 0.5: 0.159, 0.75: 0.089}
"""Share of white's light that each half-tone loses by bilinear interpolation of codes at a gamma of 2.2; from 67 to
300 % it differs by less than a fifth, and bicubic interpolation loses a fifth less."""
CLEARLY = 0.75
"""Half-tones are scaled, and channels have curves of their own, if what is left unexplained is then below this share of
what is left otherwise."""
EXPOSED = 2.0
"""Weight of relative errors of the half-tones' exposures, beside the relative errors of groups of values."""
CONTRASTS = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Shares of an S curve that a camera's curve is thought to have, beside sRGB's:"""
USUAL_CONTRAST = (0.3, 0.25)
"""their mean and standard deviation, before half-tones are seen."""
RESIDUAL = 0.03
"""Length of the residual, in relative errors, that a contrast loses a standard deviation by."""
SMOOTH = 0.1
"""Weight of the curvature of the slopes; it decides between values, and just beyond them."""
USUAL = 1.0
"""Weight of the slopes' difference from the usual ones, times how far their code is from the values seen."""
DARK = 0.02
"""Light below which relative errors count no more."""

Floats = NDArray[np.float32]

_CODES = np.linspace(0, 1, SAMPLES, dtype=np.float32)


class Shown(NamedTuple):
    """Frames of one light: codes, 0 to 1, of n pixels and channels, (frames, n) float32, and the exposure of each.

    The exposure is (frames, n) float64, or (frames, 1) where all have the same.
    """

    codes: Floats
    exposures: NDArray[np.float64]


class HalfTones(NamedTuple):
    """What the camera saw of a black and a white monitor, and of half-tones with some shares of white's light.

    Where there are several channels, the values of a pixel follow each other.
    """

    black: Shown
    white: Shown
    tones: Sequence[Shown]
    shares: Sequence[float]


class Fitted(NamedTuple):
    """What half-tones tell: the camera's curve, and whether the monitor showed them at another size.

    ``curve`` is a named curve if it explains the half-tones within 1 %, else samples; or there is one for each of three
    channels. It is None if there are too few values, or all are dark.
    """

    curve: CameraCurve | None
    scaled: bool


class _Fit(NamedTuple):
    """A curve, how far it is from the half-tones and from smooth, and the equations that it was fitted to."""

    curve: Curve
    left: float
    equations: NDArray[np.float64]

    def misfit(self, curve: Curve) -> float:
        """The squared error of a curve in these equations."""
        return float(np.sum((self.equations @ to_light(_CODES, curve)) ** 2))


def fit_camera_curve(seen: HalfTones, channels: int = 1) -> Fitted:
    """Fit the curve from code to light to half-tones.

    Notes
    -----
    With light F(u) of the code u, a half-tone with share t is seen as ``F(u_t) = (1 - t) F(u_black) + t F(u_white)``,
    whatever the pixel sees of the monitor and the room. Light is that of one exposure, and the mean of several frames.
    Since pixels differ in brightness, t = 1/2 alone determines F from white down to the darkest. F is a usual curve
    with its slope multiplied by a piecewise linear function, w >= 0 at the knots, so that F is monotone and the
    equations are linear in w; ``F(1) = 1`` sets the scale. They are solved by non-negative least squares, with a small
    penalty on the second differences of w, and on w - 1 where nothing is seen: else nothing sets the scale of dark
    frames. The exposure of each half-tone may be off by some per cent: those of a film are only estimated, and light
    flickers.

    Usual is sRGB after an S curve, ``(1 - c) x + c x^2 (3 - 2 x)``: cameras add contrast c, so that their codes grow
    slowly where they are bright. F is the mean over several c, weighted by how likely they are (`USUAL_CONTRAST`) and
    by how well they explain the half-tones. Of 14 drawn cameras' JPEG stills of a ball, half of them dark, the scale
    is off by 3 % in the mean, and by 8 % if all c are 0.

    Each equation is a mean over values of about the same white, because noise and dots that the camera partly resolves
    would otherwise pull towards a curve that hides them.

    A page at another zoom, or a player, interpolates between the codes of black and white dots, which are less than
    the mean light. The share that is lost, `LOST`, hardly depends on the size, and is least where dots are fewest, so
    that it is no tone curve: the half-tones are taken as scaled if they, and a smooth curve, then agree better.

    Channels have one curve as long as it explains them: it has three times the values, and is the same in all, so that
    what is grey stays grey. By one curve, half-tones of a camera whose red and blue have powers 10 % apart from green's
    are off by 1.5 %, by curves of each channel's own 0.2 %.
    """
    as_made, as_scaled = _fit(seen), _fit(seen._replace(shares=_scaled(seen.shares)))
    if as_made is None or as_scaled is None:
        return Fitted(as_made and as_made.curve, scaled=False)
    scaled = as_scaled.left < CLEARLY * as_made.left
    if scaled:  # what half-tones lose depends on the monitor's gamma, which may be another for each channel
        return Fitted(as_scaled.curve, scaled=True)
    return Fitted(as_made.curve if channels == 1 else _of_channels(seen, as_made.curve), scaled=False)


def _of_channels(seen: HalfTones, joint: Curve) -> CameraCurve:
    """The curve of each of three channels where these explain the half-tones clearly better than one of all does."""
    red, green, blue = (_fit(_channel(seen, c)) for c in range(3))
    if red is None or green is None or blue is None:
        return joint
    by_joint, by_own = (
        sum(own.misfit(curve or own.curve) for own in (red, green, blue)) for curve in (joint, None)
    )
    return (red.curve, green.curve, blue.curve) if by_own < CLEARLY**2 * by_joint else joint


def _channel(seen: HalfTones, channel: int) -> HalfTones:
    """The values of one of three channels."""

    def own(shown: Shown) -> Shown:
        exposures = np.broadcast_to(shown.exposures, shown.codes.shape)
        return Shown(shown.codes[:, channel::3], exposures[:, channel::3])

    return HalfTones(own(seen.black), own(seen.white), [own(tone) for tone in seen.tones], seen.shares)


def are_scaled(seen: HalfTones, look_up: Floats) -> bool:
    """Whether the monitor showed half-tones at another size, if the light of each code, (k,) from 0 to 1, is known."""
    low, high, *tones = (_light_of(shown, look_up) for shown in (seen.black, seen.white, *seen.tones))
    used = (high - low > MIN_CONTRAST) & (seen.white.codes < 1).all(axis=0)
    if np.count_nonzero(used) < MIN_VALUES:
        return False
    shares = np.array([np.median((tone - low)[used] / (high - low)[used]) for tone in tones])
    misfit = [np.linalg.norm(shares - expected) for expected in (seen.shares, _scaled(seen.shares))]
    return bool(misfit[1] < CLEARLY * misfit[0])


def _scaled(shares: Sequence[float]) -> list[float]:
    return [share - LOST[share] for share in shares]


def _fit(seen: HalfTones) -> _Fit | None:
    """The curve of all values; None if there are too few."""
    black, white, tones, shares = seen
    ends = np.concatenate([black.codes, white.codes])
    grey = np.concatenate([shown.codes for shown in tones])
    contrast = white.codes.mean(axis=0) - black.codes.mean(axis=0)
    used = (
        (grey > 0).all(axis=0) & (grey < 1).all(axis=0) & (ends < 1).all(axis=0) & (contrast > MIN_CONTRAST)
    )
    light = to_light(_CODES, "srgb").astype(np.float64)
    bases, knots = list(map(_basis, CONTRASTS)), np.linspace(0, 1, KNOTS)
    for furthest in (FURTHEST, None):
        # The border of a film, a hand, a reflection: what does not follow the half-tones is no part of the monitor.
        low, high = _light_of(black, light), _light_of(white, light)
        off = np.max(
            [
                np.abs((_light_of(shown, light) - low) / np.maximum(high - low, 1e-6) - share)
                for shown, share in zip(tones, shares, strict=True)
            ],
            axis=0,
        )
        kept = used & (off < (furthest or OUTLIER * np.median(off[used])))
        if np.count_nonzero(kept) < MIN_VALUES:
            return None
        bottom, top = np.quantile(black.codes[0, kept], 0.01), np.quantile(white.codes[0, kept], 0.99)
        if top < REACH:
            return None
        unseen = np.maximum(np.maximum(knots - top, bottom - knots), 0)
        equations, brighter = _equations(seen, np.flatnonzero(kept))
        light, left = _most_likely(equations, brighter, bases, unseen)
    named: list[Curve] = ["linear", "srgb"]
    misfit = [float(np.sqrt(np.mean((equations @ to_light(_CODES, curve)) ** 2))) for curve in named]
    if min(misfit) < AGREES:
        return _Fit(named[int(np.argmin(misfit))], left, equations)
    return _Fit(Sampled(light=tuple((light / light[-1]).round(6).tolist())), left, equations)


def _light_of(shown: Shown, light: NDArray[np.floating]) -> NDArray[np.float64]:
    """The mean light of frames by the samples of a curve, (n,)."""
    found = np.interp(shown.codes, np.linspace(0, 1, len(light)), light) / shown.exposures
    mean: NDArray[np.float64] = found.mean(axis=0)
    return mean


def _equations(seen: HalfTones, kept: NDArray[np.intp]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The relative error of each half-tone in each group of values, by the samples of the curve, (k, SAMPLES), and what
    it grows by with the exposure of each half-tone, (k, tones).
    """
    black, white, tones, shares = seen
    level = white.codes.mean(axis=0)
    rows, brighter = [], []
    for group in np.array_split(kept[np.argsort(level[kept], kind="stable")], BINS):
        bright = to_light(level[group], "srgb").mean() + DARK
        low, high = _mean_at(black, group), _mean_at(white, group)
        rows += [
            (_mean_at(shown, group) - (1 - share) * low - share * high) / bright
            for shown, share in zip(tones, shares, strict=True)
        ]
        brighter.append(np.diag([to_light(shown.codes[:, group], "srgb").mean() / bright for shown in tones]))
    return np.array(rows), np.concatenate(brighter)


def _most_likely(
    equations: NDArray[np.float64],
    brighter: NDArray[np.float64],
    bases: list[NDArray[np.float64]],
    unseen: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """The samples of the curve, (SAMPLES,), and the length of the least residual, from equations, what exposures change
    in them, the basis of each of the `CONTRASTS`, and how far each knot is from the codes that were seen.
    """
    curves, left = [], []
    for basis in bases:
        weights, residual = _solve(equations @ basis, brighter, basis[-1:], unseen)
        curves.append(np.maximum.accumulate(basis @ weights))
        left.append(residual)
    mean, deviation = USUAL_CONTRAST
    unlikely = ((np.array(CONTRASTS) - mean) / deviation) ** 2 + (np.array(left) / RESIDUAL) ** 2
    light: NDArray[np.float64] = np.average(curves, axis=0, weights=np.exp((unlikely.min() - unlikely) / 2))
    return light, min(left)


def _solve(
    rows: NDArray[np.float64],
    brighter: NDArray[np.float64],
    end: NDArray[np.float64],
    unseen: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """The weight of each knot, (KNOTS,), from equations, what exposures change in them, the light at the end, and how
    far each is from the codes that were seen; and the length of the residual.
    """
    from scipy.optimize import nnls  # takes half a second to import

    tones, usual = brighter.shape[1], USUAL * unseen
    curved = SMOOTH * np.sqrt(len(rows) / KNOTS) * np.diff(np.eye(KNOTS), 2, axis=0)
    exposed = np.concatenate([brighter, -brighter], axis=1)  # of either sign
    A = np.block(
        [
            [rows, exposed],
            [curved, np.zeros((len(curved), 2 * tones))],
            [np.zeros((2 * tones, KNOTS)), EXPOSED * np.eye(2 * tones)],
            [np.diag(usual), np.zeros((KNOTS, 2 * tones))],
            [1e3 * end, np.zeros((1, 2 * tones))],
        ]
    )
    weights, left = nnls(A, np.concatenate([np.zeros(len(A) - KNOTS - 1), usual, [1e3]]))
    return weights[:KNOTS], float(left)


def _basis(contrast: float) -> NDArray[np.float64]:
    """The light at each sample of the curve for a weight of 1 at each knot, (SAMPLES, KNOTS)."""
    even = np.linspace(0, 1, 16 * SAMPLES)
    plain = np.interp(_CODES, (1 - contrast) * even + contrast * even**2 * (3 - 2 * even), even)
    rise = np.diff(to_light(plain.astype(np.float32), "srgb").astype(np.float64))
    middle = (_CODES[1:] + _CODES[:-1]) / 2
    knots = np.linspace(0, 1, KNOTS)
    hats = np.stack([np.interp(middle, knots, row) for row in np.eye(KNOTS)], axis=1)
    return np.concatenate([np.zeros((1, KNOTS)), np.cumsum(rise[:, np.newaxis] * hats, axis=0)])


def _mean_at(shown: Shown, values: NDArray[np.intp]) -> NDArray[np.float64]:
    """The weight of each sample of a curve in the mean light of some values, (SAMPLES,)."""
    place = np.clip(shown.codes[:, values], 0, 1).astype(np.float64) * (SAMPLES - 1)
    below = np.minimum(place.astype(np.intp), SAMPLES - 2)
    exposures = np.broadcast_to(shown.exposures, shown.codes.shape)[:, values]
    part, over = place - below, 1 / (exposures * place.size)
    lower = np.bincount(below.ravel(), ((1 - part) * over).ravel(), SAMPLES)
    upper = np.bincount(below.ravel() + 1, (part * over).ravel(), SAMPLES)
    return np.asarray(lower + upper, np.float64)
