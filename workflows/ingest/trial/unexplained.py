"""What frames show beside T, S and rho: veiling glare, noise that constant frames don't tell, errors of the model."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.ingest.pixel_sample import Doubles, Floats, PixelSample
from workflows.ingest.trial.trial_recovery import (
    WHITE_APART,
    Calibrated,
    RecoveredSample,
    predict,
    recover_sample,
)
from workflows.recovery.camera.noise import LEAST_READ, NoiseModel, fit_noise
from workflows.recovery.glare import LEAST, Spread, centres, filter_patterns, fit_shares, spread_patterns
from workflows.recovery.normalise import normalise
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport

MEASURED = ("noise", "noise_of_patterns", "model_error", "smooth_error", "pattern_error", "glare")
"""The attributes of a stack that `find_unexplained` writes."""
ROUNDS = 5
"""Recoveries of the sample, at most: each sees the patterns through the glare that the one before has found."""
SETTLED, NOISE_SETTLED = 0.003, 0.2
"""Rounds end when no share of the glare changes by more, and the variance of the noise by no larger share."""
FLAT = 0.98
"""A pixel sees a pattern as black or white if the pattern is, about its place, by more than this, of 1. What differs is
then no error of T."""
SEEN = 0.9
"""T must give more than this of it. (If T decided alone, noise that T has fitted would be left out.)"""
DETAIL = 0.02
"""Variance of a black-and-white pattern within T that is expected to be unexplained where glare is fitted."""
LEAST_ERROR = 0.002
"""An error of the model below this share of rho is none."""
MOST = 0.98
"""Quantile of squared residuals beyond which they count no more."""
MOST_GLARE = 0.7
"""A larger share of the light is no glare: the sample sees something else, such as mostly the border of a film."""
HIDDEN = 1.5
"""Ratio of the variance of patterns to that of constant frames from which these hide noise."""
MIN_FLAT = 120
"""Values that the noise and the error of the model are measured from, at least."""
CONTRAST = 3.0
"""As `least_contrast` of a recovery."""

_GREY = np.array([0.5], np.float32)


class Unexplained(NamedTuple):
    """The last recovery of a sample, the patterns through the glare that it was recovered from, and what it left."""

    recovered: RecoveredSample
    patterns: Patterns
    rest: "Rest"


def find_unexplained(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, state: Doubles
) -> Unexplained | None:
    """Estimate what T leaves unexplained in a sample of the pixels, and annotate the stack with it.

    ``glare`` are its shares of the light (`workflows.recovery.glare`), or None below 1 %. ``model_error`` is the
    standard deviation of what neither T nor noise explains, as a share of rho; ``smooth_error`` is the part of it that
    neighbours have in common, or as much if there are too few. ``pattern_error`` is the root mean
    square difference of all patterns from what T predicts, in camera units. ``noise`` is replaced if it was only
    assumed, for want of constant frames, if that of patterns is larger, or in a film smaller: ``noise_of_patterns``
    says whether.

    Parameters
    ----------
    capture : Calibrated
    patterns : Patterns
        The program's, without glare.
    sample : PixelSample
    state : (frames, 3) float64
        Shifts and logarithms of the gains to correct.

    Returns
    -------
    Unexplained or None
        None if the sample has too little contrast, or every measurement of it is clipped.

    Notes
    -----
    Where T lies in a part of a pattern that is all black or all white, no error of T's place or shape matters. What
    still differs there is glare, whose shares are fitted, and then noise and errors of the model: scattered light, a
    curve that is not quite right, a monitor whose white depends on the picture. Errors of the model are alike in the
    three channels, and noise is not, so that the covariance of the channels tells them apart. Compression makes errors
    that are alike in the channels, but not in neighbouring pixels: they limit the weight of a measurement, but
    composites have little of them, since patterns are many.
    """
    stack = capture.stack
    stack.annotate(glare=None, model_error=0.0, smooth_error=0.0, pattern_error=None)
    before, assumed = NoiseModel(**stack.attributes["noise"]), stack.attributes["assumed_noise"]
    noise, of_patterns = before, stack.attributes["noise_of_patterns"]
    spreads, through = spread_patterns(patterns), patterns
    shares, error = np.zeros(len(spreads)), 0.0
    rounds = 0
    while True:
        rounds += 1
        stack.annotate(noise={"read": noise.read, "shot": noise.shot}, model_error=error)
        found = recover_sample(capture, through, sample, state)
        if found is None:
            return None
        rest = Rest(capture, found, patterns, through, spreads, noise)
        if not rest.known.any():
            return None
        last = shares
        shares = rest.shares(error)
        if not LEAST <= shares.sum() <= MOST_GLARE:
            shares = np.zeros(len(spreads))
        known = noise
        noise, error = rest.noise_and_error(noise, assumed)
        settled = bool(np.abs(shares - last).max() < SETTLED)
        settled &= bool(abs(noise.variance(_GREY)[0] / known.variance(_GREY)[0] - 1) < NOISE_SETTLED)
        if settled or rounds == ROUNDS:
            stack.annotate(
                noise={"read": noise.read, "shot": noise.shot},
                model_error=error,
                smooth_error=min(error, rest.smooth_error(sample, error)),
                glare=[round(float(share), 5) for share in shares] if shares.any() else None,
                pattern_error=rest.pattern_error(),
                noise_of_patterns=of_patterns or noise != before,
            )
            return Unexplained(found, through, rest)
        through = filter_patterns(patterns, spreads, shares.tolist()) if shares.any() else patterns


class Rest:
    """The residuals of a recovered sample, in units of T from -1 to 1; arrays are (n, channels, m)."""

    def __init__(
        self,
        capture: Calibrated,
        found: RecoveredSample,
        patterns: Patterns,
        through: Patterns,
        spreads: list[Spread],
        noise: NoiseModel,
    ) -> None:
        stack, shown, self.noise = capture.stack, capture.program.measured, noise
        channels = stack.channels
        self.filmed = "video" in stack.attributes
        at = slice(None, channels)
        first = {pattern: frame for frame, pattern in reversed(list(enumerate(stack.attributes["patterns"])))}
        self.frames = np.array([first.get(pattern, 0) for pattern in shown.tolist()])
        light = found.light.of_patterns(shown)
        measured = normalise(light, found.photometry, noise, CONTRAST)
        value, self.variance = (part[:, at, :-2] for part in measured)
        self.plain, seen = (predict(found.transport, p)[:, at] for p in (patterns, through))
        self.known = (
            np.isfinite(self.variance) & (found.transport.count.sum(axis=1) > 0)[:, np.newaxis, np.newaxis]
        )
        self.rho = np.broadcast_to(found.photometry.rho[:, at, np.newaxis], value.shape)
        self.worth = light.worth.transpose(0, 2, 1)[:, at]
        # Not as measured: then values of a bin would have been chosen by their noise.
        self.level = found.photometry.S[:, at, np.newaxis] + self.rho * (1 + seen) / 2
        strays = found.strays[1:, :-2]
        self.rest = _without(np.where(self.known, value - seen, 0), strays)
        self.from_plain = _without(np.where(self.known, value - self.plain, 0), strays)
        x, y = mean_places(found.transport, patterns.pyramid)
        self.parts = np.empty((*self.plain.shape, len(spreads)), np.float32)
        for k, spread in enumerate(spreads):
            for c in range(channels):
                lit = spread.at(x[:, c], y[:, c]).reshape(len(x), -1, patterns.count)
                self.parts[:, c, :, k] = lit[:, c % lit.shape[1]]
        near, sign = self.parts[..., 0], np.sign(self.plain)
        self.flat = self.known & (sign * near > FLAT) & (sign * self.plain > SEEN)

    def shares(self, error: float) -> NDArray[np.float64]:
        """The shares of the glare that explain the residuals best."""
        parts = self.parts - self.plain[..., np.newaxis]
        brightness = self.rho / max(float(np.median(self.rho)), 1e-6)
        weight = np.minimum(brightness, 2) ** 2
        weight /= (
            np.where(self.known, self.variance, 1) + 4 * error**2 + DETAIL * np.maximum(1 - self.plain**2, 0)
        )
        return fit_shares(parts[self.known], self.from_plain[self.known], weight[self.known])

    def size(self) -> float:
        """The median of the residuals' magnitudes, in units of T: few pixels, as at edges, have most of the squares."""
        return float(np.median(np.abs(self.rest[self.known])))

    def pattern_error(self) -> float:
        """Root mean square of the residuals, in camera units."""
        return float(np.sqrt(np.mean(self._squares(self.known))))

    def noise_and_error(self, noise: NoiseModel, assumed: bool) -> tuple[NoiseModel, float]:
        """The noise of a frame and the error of the model.

        Of three channels, what each and the next one have in common is the error. Of one channel the error is what is
        left beside the noise, or nothing where that is only assumed.
        """
        flat, in_colour = self.flat, self.rest.shape[1] == 3
        if in_colour:
            flat = flat & np.roll(flat, -1, axis=1)
        if np.count_nonzero(flat) < MIN_FLAT:
            return noise, 0.0
        if in_colour:
            common, square = self._pairs(flat)
            noise = self._noise(flat, square, noise, assumed)
        elif assumed:
            common, noise = 0.0, self._noise(flat, self._squares(flat), noise, assumed)
        else:
            common = _mean_without_outliers(self.rest[flat] ** 2) - float(self.variance[flat].mean())
        error = float(np.sqrt(max(common, 0.0)) / 2)
        return noise, error if error >= LEAST_ERROR else 0.0

    def _squares(self, at: NDArray[np.bool_]) -> NDArray[np.floating]:
        """The squares of some residuals, in camera units."""
        squares: NDArray[np.floating] = (self.rest[at] / 2 * self.rho[at]) ** 2
        return squares

    def _pairs(self, flat: NDArray[np.bool_]) -> tuple[float, NDArray[np.floating]]:
        """What each channel and the next one have in common, a mean square in units of T, and what sets them apart: the
        squared errors of a frame, in camera units.
        """
        own, other = self.rest[flat], np.roll(self.rest, -1, axis=1)[flat]
        # Under patterns in colour a channel may see white, and the next one black.
        lit = (self.plain > 0).astype(np.float32)
        apart = own - other - self._brighter() * (lit - np.roll(lit, -1, axis=1))[flat]
        # The variance of a difference, in units of T, is the sum of two: that of a frame over rho squared of each.
        rho, of_other = self.rho[flat] ** 2, np.roll(self.rho, -1, axis=1)[flat] ** 2
        return _mean_without_outliers(own * other), apart**2 / 4 * rho * of_other / (rho + of_other)

    def _noise(
        self, flat: NDArray[np.bool_], square: NDArray[np.floating], noise: NoiseModel, assumed: bool
    ) -> NoiseModel:
        """The noise of a frame by squared errors of patterns.

        That of constant frames, unless it is only assumed, is kept if it is about the same. JPEG and noise reduction
        hide noise where a picture is flat.
        """
        level, floor = self.level[flat].astype(np.float64), max(noise.read / 100, LEAST_READ)

        def fitted(square: NDArray[np.floating]) -> NoiseModel | None:
            return fit_noise(level, (square * self.worth[flat]).astype(np.float64), floor)

        found = fitted(square) or noise
        if assumed or found.variance(_GREY)[0] > HIDDEN * noise.variance(_GREY)[0]:
            return found
        # Exposures and local tone mapping that are not quite right widen what a film shows beyond black and white,
        # which its noise was measured by. All that is left is an upper limit.
        limit = fitted(self._squares(flat)) if self.filmed else None
        return limit if limit and limit.variance(_GREY)[0] < noise.variance(_GREY)[0] else noise

    def _brighter(self) -> float:
        """By how much what is white in patterns is brighter than white frames, in units of T; 0 if by a trifle."""
        white = self.rest[self.flat & (self.plain > 0)]
        more = float(np.median(white)) if white.size else 0.0
        return more if abs(more) >= 2 * WHITE_APART else 0.0

    def smooth_error(self, sample: PixelSample, otherwise: float) -> float:
        """The error of the model in a film by pixels above each other, where both see a pattern alike."""
        if not self.filmed:
            return otherwise
        index = {place: n for n, place in enumerate(zip(*(at.tolist() for at in sample.chosen), strict=True))}
        below = [(n, index.get((square, y + 1, x))) for (square, y, x), n in index.items()]
        pairs = np.array([pair for pair in below if pair[1] is not None], np.intp).reshape(-1, 2).T
        both = self.flat[pairs].all(axis=0) & (self.plain[pairs[0]] * self.plain[pairs[1]] > 0)
        if np.count_nonzero(both) < MIN_FLAT:
            return otherwise
        common = _mean_without_outliers((self.rest[pairs[0]] * self.rest[pairs[1]])[both])
        return float(np.sqrt(max(common, 0.0)) / 2)


def mean_places(transport: Transport, pyramid: Pyramid) -> tuple[Doubles, Doubles]:
    """The mean place that each row of T sees, x and y in cells of the first grid, (n, 3) float64 each."""
    row = np.repeat(np.arange(transport.count.size), transport.count.ravel())
    n, channels = transport.count.shape
    own = np.where(transport.shared[:, np.newaxis], 0, np.arange(channels))
    total = np.maximum(np.bincount(row, transport.weight, n * channels), 1e-12)
    places = []
    for centre in centres(pyramid):
        mean = np.bincount(row, transport.weight * centre[transport.cell], n * channels) / total
        places.append(np.take_along_axis(mean.reshape(n, channels), own, axis=1))
    return places[0], places[1]


def _without(rest: Floats, strays: Floats) -> Floats:
    """Residuals without what stray light explains in each."""
    if not len(strays):
        return rest
    left: Floats = rest - (rest @ np.linalg.pinv(strays).astype(np.float32)) @ strays
    return left


def _mean_without_outliers(values: Floats) -> float:
    limit = np.quantile(np.abs(values), MOST)
    return float(np.clip(values, -limit, limit).mean())
