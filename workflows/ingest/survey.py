"""How a capture turned out: clipping, exposure, the camera's drift and the light's flicker, from windows of frames."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.captures import Stack
from storage.objects import Objects
from workflows.ingest.measure import constant_frames
from workflows.program import Program
from workflows.recovery.noise import Noise
from workflows.tone import Curve, table

EDGE = 96
"""Pixels of a window, at most; there are four by four, spread over the frame."""
FRAMES = 2000
"""Frames that are looked at, at most, spread over the capture."""
BATCH = 32 << 20
"""Bytes of a window's frames that are read at once, about."""
CONTRAST = 10.0
"""Standard deviations of a mid-grey value between black and white, from which a pixel says something of the light."""
FEWEST = 500
"""Pixels that see white blocks, from which the light of a frame is told."""
QUARTERS = 4
"""Times of the capture at which the camera's place is told."""
PEAK = 5.0
"""Pixels that see only white, over those that see a tenth less of it: what makes a peak."""

_BINS = 400
_LOW, _HIGH = 0.6, 1.4

Floats = NDArray[np.float64]


def survey(objects: Objects, capture: str) -> None:
    """Measure what a report on a capture needs, and write it into the stack's attributes as ``survey``.

    Notes
    -----
    *Flicker*. A pixel that sees only white blocks has the value of the white frame. The values between black (0) and
    white (1) of such pixels are a peak at 1, which moves with the light; it is told by a median around it, and only in
    frames that have the peak.

    *Drift*. The mean of a quarter's patterns, less that of all, is fitted by the latter's gradient: a shift d of the
    camera changes an image M by ``-d grad M``. That the quarter had other patterns changes it as well, so each window
    has a brightness and a contrast of its own, second-order polynomials of the place, and what windows disagree by says
    how far to trust it.
    """
    stack = Stack(objects, capture)
    attributes = stack.attributes
    program = Program.model_validate(attributes["program"])
    camera: Curve = TypeAdapter[Curve](Curve).validate_python(attributes["camera_curve"])
    look_up = table(camera, stack.dtype, attributes["storage"]["black"])
    exposures = np.array(attributes["exposures"], np.float32)
    exposures /= exposures.min()
    patterns = np.array(attributes["patterns"])
    chosen = np.unique(np.linspace(0, stack.frames - 1, FRAMES).astype(int))
    is_pattern = ~np.isin(patterns[chosen], program.constants[0])
    # Of the shown patterns alone: constants have no part in the mean image, and patterns that repeat count as often.
    shown = np.flatnonzero(is_pattern)
    quarter = np.full(len(chosen), -1)
    quarter[shown] = np.arange(len(shown)) * QUARTERS // max(len(shown), 1)

    frames, sent, times = constant_frames(stack, program)
    level = sent.mean(axis=1) + np.where(times == times.min(), 0, np.nan)
    white, black = frames[int(np.nanargmax(level))], frames[int(np.nanargmin(level))]
    noise = Noise(**attributes["noise"])

    clipped = np.zeros((2, len(chosen)), np.int64)
    ends = np.zeros((2, 2))
    lit: NDArray[np.int64] = np.zeros((len(chosen), _BINS), np.int64)
    contrasts: list[NDArray[np.float32]] = []
    deviations: list[NDArray[np.float32]] = []
    brightest: list[NDArray[np.float32]] = []
    shifts = _Shifts()
    pixels = 0
    for rows, columns in _windows(stack):
        wanted = stack.recovered(rows, columns)
        if not wanted.any():
            continue
        codes_black, codes_white = (stack.read(rows, columns, slice(n, n + 1))[0] for n in (black, white))
        B, W = look_up[codes_black].mean(axis=2), look_up[codes_white].mean(axis=2)
        top = np.iinfo(stack.dtype).max
        pixels += int(np.count_nonzero(wanted))
        ends[0] += [np.count_nonzero((c == 0).any(axis=2) & wanted) for c in (codes_black, codes_white)]
        ends[1] += [np.count_nonzero((c == top).any(axis=2) & wanted) for c in (codes_black, codes_white)]
        deviation = np.sqrt(noise.variance((B + W) / 2) / stack.channels)
        contrasts.append((W - B)[wanted])
        deviations.append(np.sqrt(noise.variance((B + W) / 2))[wanted])
        brightest.append(look_up[codes_white].max(axis=2)[wanted])
        sure = (CONTRAST * deviation < W - B) & (codes_white < top).all(axis=2)
        sums = np.zeros((QUARTERS, *B.shape))
        for at, codes in _batches(stack, rows, columns, chosen):
            for end, value in enumerate((0, top)):
                clipped[end, at] += ((codes == value).any(axis=3) & wanted).sum(axis=(1, 2))
            grey = look_up[codes].mean(axis=3) / exposures[chosen[at], np.newaxis, np.newaxis]
            for q in range(QUARTERS):
                sums[q] += grey[quarter[at] == q].sum(axis=0)
            share = (grey[:, sure] - B[sure]) / (W - B)[sure]
            cells = np.floor((share - _LOW) / (_HIGH - _LOW) * _BINS).astype(int)
            inside = (cells >= 0) & (cells < _BINS)
            row = np.broadcast_to(np.arange(len(codes))[:, np.newaxis], cells.shape)
            flat = np.bincount(row[inside] * _BINS + cells[inside], minlength=len(codes) * _BINS)
            lit[at] += flat.reshape(-1, _BINS)
        counts = np.bincount(quarter[shown], minlength=QUARTERS)
        if counts.min() > 0:
            shifts.add(sums / counts[:, np.newaxis, np.newaxis])
    contrast, middling, bright = (
        _percentile(c, q) for c, q in ((contrasts, 50), (deviations, 50), (brightest, 99))
    )
    share = clipped / max(pixels, 1)
    stack.annotate(
        survey={
            "pixels": pixels,
            "black": {"clipped_low": ends[0, 0] / max(pixels, 1)},
            "white": {
                "clipped_high": ends[1, 1] / max(pixels, 1),
                "reaches": bright,
            },
            "patterns": {
                "clipped_low": float(share[0, is_pattern].mean()),
                "clipped_high": float(share[1, is_pattern].mean()),
            },
            "contrast": contrast,
            "deviation": middling,
            "drift": shifts.solve(),
            "flicker": _flicker(lit[is_pattern], chosen[is_pattern]),
        }
    )


def _percentile(values: list[NDArray[np.float32]], q: float) -> float:
    return float(np.percentile(np.concatenate(values), q)) if values else 0.0


def _windows(stack: Stack) -> Iterator[tuple[slice, slice]]:
    def spread(n: int) -> list[slice]:
        length = min(EDGE, max(1, -(-n // 4)))
        return [slice(start, start + length) for start in sorted({(n - length) * k // 3 for k in range(4)})]

    return product(spread(stack.height), spread(stack.width))


def _batches(
    stack: Stack, rows: slice, columns: slice, chosen: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], NDArray[Any]]]:
    """The chosen frames of a window, some at a time: their places among the chosen, and their values."""
    size = (rows.stop - rows.start) * (columns.stop - columns.start) * stack.channels * stack.dtype.itemsize
    # Values become floats, by then of several kinds.
    step = max(1, BATCH // (16 * size))
    for first in range(0, len(chosen), step):
        at = np.arange(first, min(first + step, len(chosen)))
        yield at, stack.pick(chosen[at].tolist(), rows, columns)


class _Shifts:
    """Collects, window by window, the normal equations of each quarter's shift against the mean of all."""

    def __init__(self) -> None:
        self._gram: list[Floats] = []
        self._side: list[Floats] = []

    def add(self, means: Floats) -> None:
        """Take a window: (quarters, h, w) mean light."""
        if min(means.shape[1:]) < 8:
            return
        whole = means.mean(axis=0)
        dy, dx = (g[1:-1, 1:-1].ravel() for g in np.gradient(whole))
        inner = whole[1:-1, 1:-1]
        y, x = (np.linspace(-1, 1, n) for n in inner.shape)
        bent = [
            np.outer(b, a)
            for a, b in ((x**0, y**0), (x, y**0), (x**0, y), (x**2, y**0), (x, y), (x**0, y**2))
        ]
        own, _ = np.linalg.qr(np.stack([p.ravel() for plane in bent for p in (plane, plane * inner)], axis=1))
        gradient = np.stack([dx, dy], axis=1)
        gradient -= own @ (own.T @ gradient)
        left = (means[:, 1:-1, 1:-1] - inner).reshape(QUARTERS, -1)
        self._gram.append(gradient.T @ gradient)
        self._side.append(gradient.T @ left.T)

    def solve(self) -> dict[str, Any] | None:
        """The shifts, and the standard error of a distance; None where the frames have too little structure."""
        gram, side = np.array(self._gram), np.array(self._side)
        # of all windows, and of all but one each: what differs is the error (jackknife)
        count = len(gram)
        if count < 4 or np.linalg.eigvalsh(gram.sum(axis=0) - gram)[:, 0].min() <= 0:
            return None
        shift = -np.linalg.solve(gram.sum(axis=0), side.sum(axis=0)).T
        others = np.linalg.solve(gram.sum(axis=0) - gram, side.sum(axis=0) - side)
        error = np.sqrt((count - 1) / count * ((others - others.mean(axis=0)) ** 2).sum(axis=(0, 1)).max())
        apart = shift[:, np.newaxis] - shift
        return {
            "pixels": float(np.sqrt((apart**2).sum(axis=2)).max()),
            "error": float(2**0.5 * error),
            "quarters": shift.round(3).tolist(),
        }


def _flicker(lit: NDArray[np.int64], frames: NDArray[np.intp]) -> dict[str, Any] | None:
    """How much the light varied, from (n, bins) counts of values about white of n frames."""
    gains, of_frame = [], []
    middle = _LOW + (np.arange(_BINS) + 0.5) * (_HIGH - _LOW) / _BINS
    for counts, frame in zip(lit, frames.tolist(), strict=True):
        centre = 1.0
        for width in (0.3, 0.2, 0.1, 0.06, 0.06, 0.06):
            near = np.where(np.abs(middle - centre) <= width, counts, 0)
            total = np.cumsum(near)
            if total[-1] < FEWEST:
                break
            centre = float(np.interp(total[-1] / 2, total, middle + (_HIGH - _LOW) / _BINS / 2))
        else:
            if abs(centre - 1) > 0.25:
                continue  # the edge of what was counted
            peak = counts[np.abs(middle - centre) < 0.02].mean()
            if peak < PEAK * counts[np.abs(middle - centre + 0.1) < 0.03].mean():
                continue  # finer blocks than pixels see apart
            gains.append(centre)
            of_frame.append(frame)
    if len(gains) < 8:
        return None
    gain = np.array(gains)
    off = gain / np.median(gain) - 1
    worst = int(np.argmax(np.abs(off)))
    return {
        "percent": float(100 * off.std()),
        "worst_percent": float(100 * off[worst]),
        "worst_frame": of_frame[worst],
        "frames": len(gains),
    }
