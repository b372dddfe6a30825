"""Recover some pixels of a capture, and measure how each frame differs from what the recovery predicts."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve, to_light
from workflows.ingest.light.measured_light import light_of
from workflows.ingest.light.observation import conditions_of, observe
from workflows.ingest.light.stack_attributes import exposures_of
from workflows.ingest.pixel_sample import MIN_PIXELS, Doubles, Floats, PixelSample, Seen, see_sample
from workflows.programs.program import Program
from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA, NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.lobes.recover import Recovery, recover
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport
from workflows.threads import CORES, in_parts

ALONE = 80
"""Pixels that a thread recovers at a time, where none starts from its neighbours."""
CONTRAST = 10.0
"""Difference between black and white from which a pixel is used, in standard deviations of a mid-grey value."""
HUBER, REWEIGHTED = 1.5, 6
"""Standard deviations beyond which a value gets less weight, and how often weights are updated."""
OUTLIER = 9.0
"""The most that one value adds to a residual."""
WHITE_APART = 0.02
"""Share of the light from which on white frames differ from what is white in patterns, as before a monitor that limits
its brightness. Glare and errors of curves make less. The report tells of `workflows.ingest.report.findings.DIMMED`."""


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
    squares: NDArray[np.intp] | None = None,
    held_out: NDArray[np.bool_] | None = None,
) -> RecoveredSample | None:
    """Recover what is seen of a sample; None if it has too little contrast.

    Parameters
    ----------
    gains : (frames,) float64
        Logarithms of the gains of the frames.
    places : (n, 2) int, optional
        Rows and columns of the pixels, to start from neighbours as in a matte. Default: each pixel is fitted alone.
    squares : (n,) int, optional
        The squares of these pixels, ascending: threads then recover some of them each. Default: one recovers all.
    held_out : (n, m) bool, optional
        Which of the patterns that are measured are not used of each pixel.
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
    if held_out is not None:
        light.usable[held_out] = False
    n = len(light.values)
    firsts = np.arange(0, n, n if places is not None else ALONE)
    if squares is not None:
        begin = np.flatnonzero(np.diff(squares, prepend=-1))
        firsts = begin[np.unique(begin // ALONE, return_index=True)[1]]
    parts: dict[int, Recovery] = {}

    def recover_part(number: int) -> None:
        at = slice(firsts[number], firsts[number + 1] if number + 1 < len(firsts) else n)
        near = None if places is None else places[at]
        part = light.of_pixels(at), photometry.of_pixels(at)
        parts[number] = recover(*part, patterns, noise, options, conditions, near)

    in_parts(recover_part, range(len(firsts)), CORES)
    made = _joined([parts[number] for number in range(len(firsts))])
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
