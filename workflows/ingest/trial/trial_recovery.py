"""Recover some pixels of a capture, and measure how each frame differs from what the recovery predicts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.resample import LANCZOS_LOBES
from workflows.images.tone_curves import Curve, to_light
from workflows.ingest.camera.lit import find_lit
from workflows.ingest.local_gain import local_gain
from workflows.ingest.measured_light import (
    clipped_from,
    conditions_of,
    even_out,
    exposures_of,
    light_of,
    look_up_of,
    observe,
    odd_frames,
    unclipped_light,
)
from workflows.programs.program import Program
from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA, NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.lobes.recover import Recovery, recover
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport
from workflows.threads import CORES, in_parts

EDGE = 8
"""Side in pixels of the squares that are examined."""
SQUARES = 40
"""Squares, at most, spread over what is recovered."""
BYTES = 96 << 20
"""Bytes of their frames, at most."""
MIN_SQUARES = 8
"""Squares that are needed: the spread of their results gives the standard error."""
PIXELS = 640
"""Pixels of the squares that are recovered, at most."""
ALONE = 80
"""Pixels that a thread recovers at a time, where none starts from its neighbours."""
VALUES = 1 << 20
"""Pixels times frames that are recovered, at most."""
MIN_PIXELS = 100
"""Pixels with contrast that are needed."""
CONTRAST = 10.0
"""Difference between black and white from which a pixel is used, in standard deviations of a mid-grey value."""
FURTHEST = 3
"""Pixels that a frame may be shifted by."""
HUBER, REWEIGHTED = 1.5, 6
"""Standard deviations beyond which a value gets less weight, and how often weights are updated."""
OUTLIER = 9.0
"""The most that one value adds to a residual."""

_SLOPE = 2
# Pixels that are read around those that are examined.
_MARGIN = _SLOPE + LANCZOS_LOBES + FURTHEST

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class Calibrated(NamedTuple):
    """A capture after `calibrate`, as all trials take it.

    Attributes
    ----------
    stack : Stack
    program : Program
    monitor : Curve
        The monitor's curve.
    """

    stack: Stack
    program: Program
    monitor: Curve


class PixelSample(NamedTuple):
    """Pixels of some squares in all frames.

    Attributes
    ----------
    codes : (frames, squares, h, w, channels) uint8 or uint16
        With `_MARGIN` on each side.
    chosen : three (n,) intp
        Square, row and column of each pixel, counted without the margins.
    every : three (k,) intp
        All pixels of the squares that are to be recovered and see the monitor, likewise.
    wanted : int
        Pixels of the whole frame that are to be recovered and see the monitor.
    corners : (squares, 2) intp
        Row and column in the frame of the first pixel of each square.
    """

    codes: Codes
    chosen: tuple[NDArray[np.intp], ...]
    every: tuple[NDArray[np.intp], ...]
    wanted: int
    corners: NDArray[np.intp]

    @property
    def places(self) -> NDArray[np.intp]:
        """Row and column of each pixel in the frame, (2, n)."""
        return self.corners[self.chosen[0]].T + self.chosen[1:]

    def rings(self, widest: int) -> list[Floats]:
        """The mean codes, as a share of full scale, of the square rings around each pixel, (frames, n) each: of its 8
        neighbours, of the 16 pixels around these, and so on.
        """
        square, y, x = self.chosen
        grey = self.codes.mean(axis=4, dtype=np.float32) / np.float32(np.iinfo(self.codes.dtype).max)
        edges = range(1, 2 * widest + 2, 2)
        sums = [
            uniform_filter(grey, (0, 0, edge, edge))[:, square, y + _MARGIN, x + _MARGIN] * edge**2
            for edge in edges
        ]
        return [(sums[n] - sums[n - 1]) / (8 * n) for n in range(1, len(sums))]

    def thinned(self, most: int) -> "PixelSample":
        """The same squares with at most so many of the chosen pixels, spread over all of them."""
        step = -(-len(self.chosen[0]) // most)
        return self._replace(chosen=tuple(axis[::step] for axis in self.chosen))

    def some_squares(self) -> "PixelSample":
        """All pixels of some of the squares, about as many as were chosen."""
        step = -(-len(self.every[0]) // len(self.chosen[0]))
        whole = self.every[0] % step == 0
        return self._replace(chosen=tuple(axis[whole] for axis in self.every))


class Seen(NamedTuple):
    """The sample in frames that were shifted back; all arrays are (frames, n, channels)."""

    values: Floats
    whole: NDArray[np.bool_]
    slopes: tuple[Floats, Floats]


class Trial(NamedTuple):
    """How the frames differ from the prediction of a trial recovery.

    Attributes
    ----------
    off : (frames, 3) float64
        Remaining shift x and y in pixels, and logarithm of the gain; NaN where they can't be measured.
    error : (frames, 3) float64
        Standard errors.
    residual : float
        Root mean square of what T does not explain, without outliers, in standard deviations of the noise.
    """

    off: Doubles
    error: Doubles
    residual: float


def take_sample(stack: Stack, masked: bool = True) -> PixelSample | None:
    """Choose squares spread over the pixels to recover that see the monitor, and pixels in them; None if there are too
    few. Unless ``masked``, all that see the monitor are taken for those to recover.
    """
    wanted = find_lit(stack, Program.model_validate(stack.attributes["program"]))
    if masked:
        wanted &= stack.mask()
    down, across = (np.arange(_MARGIN, size - _MARGIN - EDGE + 1, EDGE) for size in wanted.shape)
    corners = [(y, x) for y in down.tolist() for x in across.tolist()]
    counts = np.array([np.count_nonzero(wanted[y : y + EDGE, x : x + EDGE]) for y, x in corners], int)
    useful = np.flatnonzero(counts >= EDGE**2 // 4)
    size = stack.frames * (EDGE + 2 * _MARGIN) ** 2 * stack.channels * stack.dtype.itemsize
    most = min(len(useful), SQUARES, BYTES // size)
    if most < MIN_SQUARES:
        return None
    corners = [corners[useful[at]] for at in np.linspace(0, len(useful) - 1, most).astype(int)]
    wide = EDGE + _MARGIN
    squares = [stack.read(slice(y - _MARGIN, y + wide), slice(x - _MARGIN, x + wide)) for y, x in corners]
    inside = np.stack([wanted[y : y + EDGE, x : x + EDGE] for y, x in corners])
    every = np.nonzero(inside)
    limit = max(min(PIXELS, VALUES // stack.frames), MIN_PIXELS)
    count = int(np.count_nonzero(wanted))
    whole = PixelSample(np.stack(squares, axis=1), every, every, count, np.array(corners, np.intp))
    return whole.thinned(limit)


def see_sample(stack: Stack, sample: PixelSample, shifts: Doubles) -> Seen:
    """The sample in frames that are shifted back."""
    look_up = look_up_of(stack)
    square, y, x = sample.chosen
    y, x = y + _SLOPE, x + _SLOPE
    shape = (stack.frames, len(square), stack.channels)
    values, across, down = np.empty((3, *shape), np.float32)
    whole, odd = np.empty(shape, bool), set(odd_frames(stack.attributes))
    for n, (codes, shift) in enumerate(zip(sample.codes, shifts.tolist(), strict=True)):
        picture, unclipped = unclipped_light(codes, shift, _MARGIN - _SLOPE, look_up, clipped_from(stack))
        picture = even_out(picture, n, stack.attributes)
        values[n], whole[n] = picture[square, y, x], unclipped[square, y, x] & (n not in odd)
        # The slope of the polynomial through five values.
        for slope, (dy, dx) in ((across, (0, 1)), (down, (1, 0))):
            near = picture[square, y + dy, x + dx] - picture[square, y - dy, x - dx]
            far = picture[square, y + 2 * dy, x + 2 * dx] - picture[square, y - 2 * dy, x - 2 * dx]
            slope[n] = (8 * near - far) / 12
    gain = local_gain(stack)
    if gain is not None:
        local = gain.at(*sample.places)[..., np.newaxis]
        for part in (values, across, down):
            part /= local
    return Seen(values, whole, (across, down))


class RecoveredSample(NamedTuple):
    """The recovery of a sample.

    Attributes
    ----------
    light : PatternLight
        Of each pattern, at the n pixels of the sample.
    photometry : Photometry
    transport : Transport
        Without glare.
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.normalise.Conditions`.
    stray : (n, m, 3) float32 or None
        As in :class:`~workflows.recovery.lobes.recover.Recovery`.
    alive : (n, 3) bool
        Where there is enough contrast.
    seen : Seen
    """

    light: PatternLight
    photometry: Photometry
    transport: Transport
    strays: Floats
    stray: Floats | None
    alive: NDArray[np.bool_]
    seen: Seen


def recover_sample(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, state: Doubles
) -> RecoveredSample | None:
    """Recover the sample from frames corrected by ``state``, (frames, 3); None if it has too little contrast."""
    seen = see_sample(capture.stack, sample, state[:, :2])
    return recover_seen(capture, patterns, seen, state[:, 2])


def recover_seen(
    capture: Calibrated,
    patterns: Patterns,
    seen: Seen,
    gains: Doubles,
    options: LobesOptions = FINE,
    places: NDArray[np.intp] | None = None,
    held_out: Sequence[int] | NDArray[np.intp] = (),
) -> RecoveredSample | None:
    """Recover what is seen of a sample; None if it has too little contrast.

    Parameters
    ----------
    gains : (frames,) float64
        Logarithms of the gains of the frames.
    places : (n, 2) int, optional
        Rows and columns of the pixels, to start from neighbours as in a matte. Default: each pixel is fitted alone.
    held_out : sequence of int, optional
        Patterns, as numbers among those measured, that are not used.
    """
    stack, program, monitor = capture
    attributes = stack.attributes | {"gains": np.exp(gains).tolist() if gains.any() else None}
    noise = NoiseModel(**attributes["noise"])
    found = light_of(lambda n: (seen.values[n], seen.whole[n]), attributes, program, seen.values.shape[1])
    photometry, light = observe(found, attributes, program, monitor)
    alive = photometry.rho**2 > CONTRAST**2 * noise.variance(photometry.S + photometry.rho / 2)
    if np.count_nonzero(alive.any(axis=1)) < MIN_PIXELS:
        return None
    conditions = conditions_of(stack, program)
    light.usable[:, held_out] = False
    n = len(light.values)
    firsts = range(0, n, n if places is not None else ALONE)
    parts: dict[int, Recovery] = {}

    def recover_part(first: int) -> None:
        at = slice(first, first + firsts.step)
        of_part = Photometry(*(values[at] for values in photometry))
        parts[first] = recover(light.of_pixels(at), of_part, patterns, noise, options, conditions, places)

    in_parts(recover_part, firsts, CORES)
    made = _joined([parts[first] for first in firsts])
    assert conditions.strays is not None
    return RecoveredSample(found, made.photometry, made.transport, conditions.strays, made.stray, alive, seen)


def _joined(parts: list[Recovery]) -> Recovery:
    """The recovery of the pixels of all parts, in order."""
    transports, photometries, errors, strays = zip(*parts, strict=True)
    return Recovery(
        Transport.concatenate(transports),
        Photometry(*map(np.concatenate, zip(*photometries, strict=True))),
        np.concatenate(errors),
        None if strays[0] is None else np.concatenate(strays),
    )


def try_recovery(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, state: Doubles
) -> Trial | None:
    """Recover the sample from frames corrected by ``state``, (frames, 3), and measure what remains."""
    found = recover_sample(capture, patterns, sample, state)
    return found and measure_rest(capture, patterns, sample, state, found)


def measure_rest(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, state: Doubles, found: RecoveredSample
) -> Trial:
    """Measure how the frames differ from what the recovery of a sample predicts."""
    stack, program, monitor = capture
    photometry, transport, alive, seen = found.photometry, found.transport, found.alive, found.seen
    attributes, gains = stack.attributes, np.exp(state[:, 2])
    noise, model_error = NoiseModel(**attributes["noise"]), attributes["model_error"]
    numbers, sent = program.constants_among(attributes["patterns"])
    shown = program.measured
    predicted = np.zeros((program.count, *alive.shape), np.float32)
    predicted[shown] = photometry.rho * (predict(transport, patterns).transpose(2, 0, 1) + 1) / 2
    predicted[numbers] = photometry.rho * to_light(sent, monitor)[:, np.newaxis]
    exposures = exposures_of(attributes)
    apart = np.linalg.inv(np.array(attributes["crosstalk"])).astype(np.float32).T
    off, error = np.full((2, stack.frames, 3), np.nan)
    squares: list[float] = []
    for n, pattern in enumerate(attributes["patterns"]):
        value, across, down = (
            np.broadcast_to(v[n] / exposures[n], alive.shape) @ apart for v in (seen.values, *seen.slopes)
        )
        lit = np.float32(gains[n]) * predicted[pattern]
        weight = 1 / (
            noise.variance(exposures[n] * value) / exposures[n] ** 2 + (model_error * photometry.rho) ** 2
        )
        good = alive & np.broadcast_to(seen.whole[n], alive.shape)
        if not lit[good].any():
            continue
        rest = (value - photometry.S - lit)[good]
        is_shown = pattern in shown
        columns = [across, down, lit] if is_shown else [lit]
        design = np.stack([column[good] for column in columns], axis=1)
        of = np.broadcast_to(sample.chosen[0][:, np.newaxis], alive.shape)[good]
        fitted = _fit(design, rest, weight[good], of)
        if fitted is not None:
            off[n, -len(columns) :], error[n, -len(columns) :] = fitted
        if is_shown:
            squares.append(float(np.minimum(rest**2 * weight[good], OUTLIER).mean()))
    off[:, :2] *= -1
    off[:, 2] = np.log1p(np.maximum(off[:, 2], -0.9))
    return Trial(off, error, float(np.sqrt(np.mean(squares))) if squares else np.inf)


def predict(transport: Transport, patterns: Patterns) -> Floats:
    """The patterns as T gives them, -1 to 1, (n, 3, m) float32."""
    cells, place = np.unique(transport.cell, return_inverse=True)
    ends = np.concatenate([[0], np.cumsum(transport.count, dtype=np.int64)])
    size = len(transport.shared)
    T = sp.csr_array((transport.weight, place, ends), shape=(3 * size, len(cells)))
    light = (patterns.code[cells] / np.float32(127.5) - 1).reshape(
        len(cells), patterns.channels, patterns.count
    )
    predicted = np.empty((size, 3, patterns.count), np.float32)
    for c in range(3):
        rows = 3 * np.arange(size) + np.where(transport.shared, 0, c)
        predicted[:, c] = T[rows] @ light[:, c % patterns.channels]
    return predicted


def _fit(
    design: Floats, rest: Floats, weight: Floats, square: NDArray[np.intp]
) -> tuple[Doubles, Doubles] | None:
    """Robust least squares, and standard errors from the spread between squares; None if it is underdetermined."""
    scale = np.sqrt(weight.astype(np.float64))
    A, r = design * scale[:, np.newaxis], rest * scale
    trust = np.ones(len(r))
    for _ in range(REWEIGHTED):
        weighed = A * trust[:, np.newaxis]
        gram = weighed.T @ A
        if np.linalg.eigvalsh(gram)[0] <= 1e-9 * np.trace(gram):
            return None
        found = np.linalg.solve(gram, weighed.T @ r)
        size = np.abs(r - A @ found)
        trust = np.minimum(1, HUBER * MEDIAN_TO_SIGMA * np.median(size) / np.maximum(size, 1e-12))
    pull = (weighed * (r - A @ found)[:, np.newaxis]) @ np.linalg.inv(gram)
    sums = np.stack([np.bincount(square, p) for p in pull.T])
    count = np.count_nonzero(np.bincount(square))
    if count <= A.shape[1]:
        return None
    error: Doubles = np.sqrt((sums**2).sum(axis=1) * count / (count - A.shape[1]))
    return found.astype(np.float64), error
