"""The light of each pattern at some pixels, from all of its frames, corrected for drift, flicker and crosstalk."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.resample import LANCZOS_LOBES, shift_back
from workflows.images.tone_curves import light_of_codes
from workflows.ingest.light.local_gain import Surroundings
from workflows.ingest.light.stack_attributes import clipped_from, exposures_of, look_up_of, odd_frames
from workflows.programs.program import Program
from workflows.recovery.camera.pattern_light import PatternLight

TOUCHED = 0.05
"""A shifted value counts as clipped if clipped values have more than this share of its weights."""

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
FrameOf = Callable[[int], tuple[Floats, Bools]]
"""Returns the light of a frame, (n, channels), and whether it is not clipped, by the frame's index."""


def even_out(light: Floats, frame: int, attributes: dict[str, Any]) -> Floats:
    """The light of a frame, (..., channels), as of usual exposure and white balance, if the camera's changed."""
    for changed in (attributes.get("auto_exposure"), attributes.get("white_balance")):
        if changed is not None:
            light = light / np.float32(changed[frame])
    return light


def read_light(
    stack: Stack,
    span: tuple[slice, slice],
    program: Program,
    gain: Surroundings | None,
    wanted: Bools | None = None,
) -> tuple[PatternLight, Bools]:
    """The light of each pattern at the pixels of a rectangle that are to be recovered, and their (y, x) bool mask.

    Drift, flicker and local tone mapping are corrected if `workflows.ingest.trial.steadiness` was certain of them,
    crosstalk always.

    Parameters
    ----------
    stack : Stack
    span : (slice, slice)
        Rows and columns. If they have a step, frames that drift are shifted by whole pixels only.
    program : Program
    gain : Surroundings or None
        As from `workflows.ingest.light.local_gain.local_gain`.
    wanted : (y, x) bool, optional
        Which pixels of the rectangle are wanted of those to be recovered; all by default.

    Raises
    ------
    Corrupt
        If a chunk of the stack is missing.
    """
    attributes = stack.attributes
    shifts = attributes.get("shifts")
    look_up = look_up_of(stack)
    top = clipped_from(stack)

    def corrected(light: Floats, frame: int) -> Floats:
        if gain is not None:
            light = light / gain.at(y, x, frame)[:, np.newaxis]
        return even_out(light, frame, attributes)

    if shifts is None or any(part.step for part in span):
        codes, recovered = stack.read_masked(*span) if shifts is None else _nearest(stack, span, shifts)
        recovered = recovered if wanted is None else recovered & wanted
        codes = codes[:, recovered]

        def at_rest(frame: int) -> tuple[Floats, Bools]:
            return (
                corrected(light_of_codes(codes[frame], look_up), frame),
                (codes[frame] > 0) & (codes[frame] < top),
            )

        frame_of: FrameOf = at_rest
    else:
        margin = margin_of(shifts)
        around, recovered = _around(stack, span, margin), stack.mask(*span)
        recovered = recovered if wanted is None else recovered & wanted

        def in_place(frame: int) -> tuple[Floats, Bools]:
            values, whole = unclipped_light(around[frame], shifts[frame], margin, look_up, top)
            return corrected(values[recovered], frame), whole[recovered]

        frame_of = in_place
    y, x = places_in(span, recovered).T
    return light_of(frame_of, attributes, program, int(recovered.sum())), recovered


def places_in(span: tuple[slice, slice], recovered: Bools) -> NDArray[np.intp]:
    """Rows and columns in the frame of the recovered pixels of a rectangle, (n, 2)."""
    first = [part.start or 0 for part in span]
    step = [part.step or 1 for part in span]
    places: NDArray[np.intp] = np.argwhere(recovered) * step + first
    return places


def light_of(frame_of: FrameOf, attributes: dict[str, Any], program: Program, pixels: int) -> PatternLight:
    """Merge the frames of each pattern at some pixels, and correct flicker and crosstalk.

    Notes
    -----
    A gain g of the monitor changes only its own light: ``C = S + g rho T L``. The light of a pattern is corrected to
    ``S + (C - S) / g``, where g is the weighted mean over the pattern's frames, and S is what is seen before a black
    monitor.
    """
    light, gain = merge(frame_of, attributes, program.count, pixels)
    values, usable, worth = light
    if gain is not None:
        black = np.intersect1d(program.black, attributes["patterns"])
        S = values[:, black].mean(axis=1, keepdims=True)
        values = (S + (values - S) / gain).astype(np.float32)
    crosstalk = np.array(attributes["crosstalk"])
    if np.any(crosstalk != np.eye(3)):
        values = (values @ np.linalg.inv(crosstalk).T).astype(np.float32)
        usable = usable & usable.all(axis=2, keepdims=True)
    return PatternLight(values, usable, worth)


def merge(
    frame_of: FrameOf, attributes: dict[str, Any], count: int, pixels: int
) -> tuple[PatternLight, Floats | None]:
    """Merge all frames of each of ``count`` patterns; returns their light and, if there are gains, the mean gain.

    Notes
    -----
    A frame exposed t times as long as the shortest has the value v = t x for light x, with the variance ``read + shot
    v``. Where shot noise dominates, the maximum likelihood estimate is ``sum v / sum t`` over the exposures that are
    not clipped, with the variance ``shot x / sum t``; `worth` is ``sum t``. Read noise, of which long exposures have
    relatively less, is then somewhat overestimated. The mean gain is ``sum g t / sum t``.
    """
    exposures = exposures_of(attributes)
    gains = attributes.get("gains")
    shape = (count, pixels, 3)  # a frame's values lie together while they are added
    light, worth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    every, times = np.zeros(shape, np.float32), np.zeros(count, np.float32)
    gain, mean_gain = np.zeros(shape if gains else (0, 0, 0), np.float32), np.zeros(count, np.float32)
    of_exposure: dict[tuple[int, float], list[int]] = {}
    odd = set(odd_frames(attributes))
    for frame, key in enumerate(zip(attributes["patterns"], exposures.tolist(), strict=True)):
        if frame not in odd:
            of_exposure.setdefault(key, []).append(frame)
    for (pattern, exposure), frames in of_exposure.items():
        total = np.zeros((pixels, 3), np.float32)
        whole = np.ones((pixels, 3), bool)
        for frame in frames:
            values, unclipped = frame_of(frame)
            total += values
            whole &= unclipped
        time = np.float32(len(frames) * exposure)
        light[pattern] += np.where(whole, total, 0)
        worth[pattern] += np.where(whole, time, 0)
        every[pattern] += total
        times[pattern] += time
        if gains:
            lit = np.float32(sum(gains[frame] for frame in frames) * exposure)
            gain[pattern] += np.where(whole, lit, 0)
            mean_gain[pattern] += lit
    usable = worth > 0
    np.copyto(worth, np.maximum(times, 1)[:, np.newaxis, np.newaxis], where=~usable)
    np.copyto(light, every, where=~usable)
    light /= worth
    if gains:
        np.copyto(gain, np.where(times > 0, mean_gain, 1)[:, np.newaxis, np.newaxis], where=~usable)
        gain /= worth

    def by_pixel(values: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(values.transpose(1, 0, 2))

    return PatternLight(by_pixel(light), by_pixel(usable), by_pixel(worth)), by_pixel(gain) if gains else None


def margin_of(shifts: Sequence[Sequence[float]]) -> int:
    """How many pixels around a rectangle are needed to shift frames."""
    return LANCZOS_LOBES + math.ceil(max((abs(s) for shift in shifts for s in shift), default=0))


def unclipped_light(
    codes: Codes, shift: Sequence[float], margin: int, look_up: Floats, top: int
) -> tuple[Floats, Bools]:
    """The light of a frame, shifted back to where its picture should be, and whether it is not clipped.

    Parameters
    ----------
    codes : (..., h, w, channels) uint8 or uint16
    shift : (float, float)
        x and y in pixels: what belongs at (y, x) is at (y + shift[1], x + shift[0]) of the frame.
    margin : int
        Extra pixels of `codes` on each side, at least `margin_of` the shift.
    look_up : (k,) or (k, channels) float32
        See `look_up_of`.
    top : int
        See `clipped_from`.

    Returns
    -------
    values : (..., h - 2 margin, w - 2 margin, channels) float32
    whole : the same, bool
    """
    values = shift_back(light_of_codes(codes, look_up), shift, margin)
    clipped = (codes == 0) | (codes >= top)
    if not clipped.any():
        return values, np.ones(values.shape, bool)
    return values, shift_back(clipped.astype(np.float32), shift, margin, magnitude=True) < TOUCHED


def _nearest(
    stack: Stack, span: tuple[slice, slice], shifts: Sequence[Sequence[float]]
) -> tuple[Codes, Bools]:
    """What is at some rows and columns, each frame shifted back by whole pixels, and their mask."""
    rows, columns = (
        np.arange(size)[part] for part, size in zip(span, (stack.height, stack.width), strict=True)
    )
    moved = np.rint(shifts).astype(int)
    codes = np.empty((stack.frames, rows.size, columns.size, stack.channels), stack.dtype)
    for x, y in np.unique(moved, axis=0).tolist():
        frames = np.flatnonzero((moved == (x, y)).all(axis=1))
        codes[frames] = stack.read_some(
            np.clip(rows + y, 0, stack.height - 1), np.clip(columns + x, 0, stack.width - 1), frames
        )
    return codes, stack.mask(*span)


def _around(stack: Stack, span: tuple[slice, slice], margin: int) -> Codes:
    """The values of a rectangle with a margin around it; beyond the frame, the edge is repeated."""
    inside, beyond = [], [(0, 0)]
    for given, size in zip(span, (stack.height, stack.width), strict=True):
        start, stop, _ = given.indices(size)
        first, last = max(start - margin, 0), min(stop + margin, size)
        inside.append(slice(first, last))
        beyond.append((first - (start - margin), stop + margin - last))
    return np.pad(stack.read(*inside), [*beyond, (0, 0)], mode="edge")
