"""Measure how a capture turned out: clipping, exposure and contrast, in windows of its frames where these see the
monitor.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import light_of_codes
from workflows.ingest.camera.border_exposure import BorderValues, shortest_white
from workflows.ingest.camera.calibration import constant_frames, is_free, measure
from workflows.ingest.camera.lit import find_lit, windows
from workflows.ingest.local_gain import Places, local_gain
from workflows.ingest.measured_light import clipped_from, even_out, exposures_of, look_up_of
from workflows.ingest.report.colour_detail import ColourDetail
from workflows.programs.program import Program
from workflows.recovery.camera.noise import Noise

EDGE = 96
"""Largest side of a window in pixels. Four by four windows are spread over what sees the monitor."""
FRAMES = 2000
"""Frames that are examined, at most, spread over the capture."""
COLOUR_FRAMES = 16
"""Patterns, at most, from which the lost detail of colours is estimated."""
COLOURED = 0.25
"""Share of what patterns in colour lose that composites lose, since T is found from many, beside what counts as an
error of the model: by this share, JPEG stills of five cameras are within 2.1 dB of the range that is promised."""
BATCH = 32 << 20
"""About how many bytes of a window's frames are read at a time."""


def survey(stack: Stack, border: BorderValues | None = None) -> None:
    """Measure what the report on a capture needs, and annotate the stack with it as ``survey``; it is not saved.

    Parameters
    ----------
    stack : Stack
        With its attributes after `find_steadiness`. If its frames flicker, the noise is measured again, because flicker
        is not noise. The constant frames of a free exposure have no gain.
    border : BorderValues, optional
        Of a film with a border.
    """
    if stack.attributes["gains"] is not None and not is_free(stack.attributes["auto_exposure"]):
        noise = stack.attributes["noise"]
        measure(stack, border, stack.attributes["gains"], stack.attributes["tone_mapping"])
        if stack.attributes["noise_of_patterns"]:
            stack.annotate(noise=noise)
    attributes = stack.attributes
    program = Program.model_validate(attributes["program"])
    look_up = look_up_of(stack)
    patterns = np.array(attributes["patterns"])
    frames, sent, times = constant_frames(stack, program)
    level = sent.mean(axis=1) + np.where(times == times.min(), 0, np.nan)
    white, black = frames[int(np.nanargmax(level))], frames[int(np.nanargmin(level))]
    exposed = attributes["auto_exposure"]
    if is_free(exposed):
        shortest = shortest_white(np.array(exposed), attributes["patterns"], program)
        white = white if shortest is None else shortest
    noise = Noise(**attributes["noise"])
    tones = [] if attributes["scaled"] else _halftone_frames(stack, program)
    special = [black, white, *(frame for frame, _ in tones)]
    chosen = np.union1d(np.linspace(0, stack.frames - 1, FRAMES).astype(int), special)
    is_pattern = ~np.isin(patterns[chosen], program.constants[0])
    coloured = []
    if stack.channels == 3 and ("video" in attributes or attributes.get("half_colour")):
        coloured = chosen[is_pattern][:: -(-np.count_nonzero(is_pattern) // COLOUR_FRAMES) or 1].tolist()
    top = clipped_from(stack)

    clipped = np.zeros((2, len(chosen)), np.int64)
    ends = np.zeros((2, 2))
    contrasts: list[NDArray[np.float32]] = []
    deviations: list[NDArray[np.float32]] = []
    brightest: list[NDArray[np.float32]] = []
    lit = np.zeros((2, len(tones)))  # of half-tones times white, of white squared
    detail, gain = ColourDetail(), local_gain(stack)
    pixels, seen = 0, find_lit(stack, program)

    def evened(codes: Codes, frame: int, y: Places, x: Places) -> NDArray[np.float32]:
        light = even_out(light_of_codes(codes, look_up).mean(axis=2), frame, attributes)
        return light if gain is None else light / gain.at(y, x, frame).reshape(light.shape)

    for rows, columns in windows(seen, EDGE):
        wanted = stack.mask(rows, columns) & seen[rows, columns]
        if not wanted.any():
            continue
        y, x = np.mgrid[rows, columns].reshape(2, -1)
        kept: dict[int, Codes] = {}
        for at, codes in _batches(stack, rows, columns, chosen):
            for end, there in enumerate((codes == 0, codes >= top)):
                clipped[end, at] += (there.any(axis=3) & wanted).sum(axis=(1, 2))
            found = dict(zip(chosen[at].tolist(), codes, strict=True))
            kept |= {frame: found[frame].copy() for frame in (*special, *coloured) if frame in found}
        codes_black, codes_white, *of_tones = (kept[frame] for frame in special)
        B, W = (evened(codes, frame, y, x) for codes, frame in ((codes_black, black), (codes_white, white)))
        pixels += int(np.count_nonzero(wanted))
        ends[0] += [np.count_nonzero((c == 0).any(axis=2) & wanted) for c in (codes_black, codes_white)]
        ends[1] += [np.count_nonzero((c >= top).any(axis=2) & wanted) for c in (codes_black, codes_white)]
        contrasts.append((W - B)[wanted])
        whole = wanted & ((codes_black > 0) & (codes_white < top)).all(axis=2)
        for of_tone, codes, (frame, _) in zip(lit.T, of_tones, tones, strict=True):
            tone = evened(codes, frame, y, x)
            of_tone += [((light - B) * (W - B))[whole].sum(dtype=np.float64) for light in (tone, W)]
        deviations.append(np.sqrt(noise.variance((B + W) / 2))[wanted])
        brightest.append(light_of_codes(codes_white, look_up).max(axis=2)[wanted])
        for frame in coloured:
            detail.add(even_out(light_of_codes(kept[frame], look_up), frame, attributes)[np.newaxis], wanted)
    contrast, middling, bright = (
        _percentile(c, q) for c, q in ((contrasts, 50), (deviations, 50), (brightest, 99))
    )
    share = clipped / max(pixels, 1)
    apart = lit[0] / np.maximum(lit[1], 1e-12) - [level for _, level in tones]
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
            "lost_colour": detail.lost() * (COLOURED if program.in_colour else 1),
            "grey": stack.channels == 1,
            "halftones_apart": float(apart[np.argmax(np.abs(apart))]) if lit.any() else None,
        }
    )


def _halftone_frames(stack: Stack, program: Program) -> list[tuple[int, float]]:
    """A frame of each half-tone in the shortest exposure, and the share of white's light that it should have."""
    patterns, times = np.array(stack.attributes["patterns"]), exposures_of(stack.attributes)
    frames = [np.flatnonzero((patterns == n) & (times == times.min())) for n in program.halftones[0]]
    return [
        (int(found[0]), float(level))
        for found, level in zip(frames, program.halftones[1], strict=True)
        if found.size
    ]


def _percentile(values: list[NDArray[np.float32]], q: float) -> float:
    return float(np.percentile(np.concatenate(values), q)) if values else 0.0


def _batches(
    stack: Stack, rows: slice, columns: slice, chosen: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], NDArray[Any]]]:
    """The chosen frames of a window in batches: their indices among the chosen, and their values."""
    size = (rows.stop - rows.start) * (columns.stop - columns.start) * stack.channels * stack.dtype.itemsize
    step = max(1, BATCH // size)
    for first in range(0, len(chosen), step):
        at = np.arange(first, min(first + step, len(chosen)))
        yield at, stack.read_frames(chosen[at].tolist(), rows, columns)
