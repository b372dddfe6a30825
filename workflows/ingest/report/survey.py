"""Measure how a capture turned out: clipping, exposure and contrast, in windows of its frames where these see the
monitor.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import light_of_codes
from workflows.ingest.camera.border_exposure import BorderValues, is_free, shortest_white
from workflows.ingest.camera.calibration import calibrate, constant_frames
from workflows.ingest.camera.lit import find_lit, windows
from workflows.ingest.light.local_gain import local_gain
from workflows.ingest.light.measured_light import even_out
from workflows.ingest.light.stack_attributes import (
    clipped_from,
    look_up_of,
    program_of,
    shortest_frames,
)
from workflows.ingest.report.colour_detail import ColourDetail
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel

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
        calibrate(stack, border, stack.attributes["gains"], stack.attributes["tone_mapping"])
        if stack.attributes["noise_of_patterns"]:
            stack.annotate(noise=noise)
    program = program_of(stack.attributes)
    frames = _Frames.of(stack, program)
    seen, found = find_lit(stack, program), _Windows(stack, frames)
    for rows, columns in windows(seen, EDGE):
        wanted = stack.mask(rows, columns) & seen[rows, columns]
        if wanted.any():
            found.add(rows, columns, wanted)
    stack.annotate(survey=found.figures(program))


class _Frames(NamedTuple):
    """Which frames of a stack are examined.

    Attributes
    ----------
    chosen : (n,) intp
        Ascending; with the black, the white and the half-tones among them.
    is_pattern : (n,) bool
        Which of these are of patterns that are not constant.
    black, white : int
        The darkest and the brightest constant frame.
    tones : list of (int, float)
        As of `_halftone_frames`; none if the monitor scaled them.
    coloured : list of int
        From which the lost detail of colours is estimated.
    """

    chosen: NDArray[np.intp]
    is_pattern: NDArray[np.bool_]
    black: int
    white: int
    tones: list[tuple[int, float]]
    coloured: list[int]

    @classmethod
    def of(cls, stack: Stack, program: Program) -> Self:
        attributes = stack.attributes
        frames, sent, times = constant_frames(stack, program)
        level = sent.mean(axis=1) + np.where(times == times.min(), 0, np.nan)
        white, black = frames[int(np.nanargmax(level))], frames[int(np.nanargmin(level))]
        exposed = attributes["auto_exposure"]
        if is_free(exposed):
            shortest = shortest_white(np.array(exposed), attributes["patterns"], program)
            white = white if shortest is None else shortest
        tones = [] if attributes["scaled"] else _halftone_frames(stack, program)
        special = [black, white, *(frame for frame, _ in tones)]
        chosen = np.union1d(np.linspace(0, stack.frames - 1, FRAMES).astype(int), special)
        is_pattern = ~np.isin(np.array(attributes["patterns"])[chosen], program.constants[0])
        coloured = []
        if stack.channels == 3 and ("video" in attributes or attributes.get("half_colour")):
            step = -(-np.count_nonzero(is_pattern) // COLOUR_FRAMES) or 1
            coloured = chosen[is_pattern][::step].tolist()
        return cls(chosen, is_pattern, black, white, tones, coloured)


class _Windows:
    """What windows of the frames show, added up."""

    def __init__(self, stack: Stack, frames: _Frames) -> None:
        self._stack, self._frames = stack, frames
        self._look_up, self._top, self._gain = look_up_of(stack), clipped_from(stack), local_gain(stack)
        self._noise = NoiseModel(**stack.attributes["noise"])
        self._pixels = 0
        # At black and at full scale: of each frame, and of the black and the white one.
        self._clipped = np.zeros((2, len(frames.chosen)), np.int64)
        self._ends = np.zeros((2, 2))
        self._contrasts: list[NDArray[np.float32]] = []
        self._deviations: list[NDArray[np.float32]] = []
        self._brightest: list[NDArray[np.float32]] = []
        self._lit = np.zeros((2, len(frames.tones)))  # of half-tones times white, of white squared
        self._detail = ColourDetail()

    def add(self, rows: slice, columns: slice, wanted: NDArray[np.bool_]) -> None:
        """Examine the wanted pixels of a window."""
        black, white, tones, top = self._frames.black, self._frames.white, self._frames.tones, self._top
        y, x = np.mgrid[rows, columns].reshape(2, -1)

        def evened(codes: Codes, frame: int) -> NDArray[np.float32]:
            every = even_out(light_of_codes(codes, self._look_up), frame, self._stack.attributes)
            light: NDArray[np.float32] = every.mean(axis=2)
            return light if self._gain is None else light / self._gain.at(y, x, frame).reshape(light.shape)

        kept = self._read(rows, columns, wanted)
        codes_black, codes_white = kept[black], kept[white]
        B, W = evened(codes_black, black), evened(codes_white, white)
        self._pixels += int(np.count_nonzero(wanted))
        self._ends[0] += [np.count_nonzero((c == 0).any(axis=2) & wanted) for c in (codes_black, codes_white)]
        self._ends[1] += [
            np.count_nonzero((c >= top).any(axis=2) & wanted) for c in (codes_black, codes_white)
        ]
        self._contrasts.append((W - B)[wanted])
        whole = wanted & ((codes_black > 0) & (codes_white < top)).all(axis=2)
        for of_tone, (frame, _) in zip(self._lit.T, tones, strict=True):
            tone = evened(kept[frame], frame)
            of_tone += [((light - B) * (W - B))[whole].sum(dtype=np.float64) for light in (tone, W)]
        self._deviations.append(np.sqrt(self._noise.variance((B + W) / 2))[wanted])
        self._brightest.append(light_of_codes(codes_white, self._look_up).max(axis=2)[wanted])
        for frame in self._frames.coloured:
            light = even_out(light_of_codes(kept[frame], self._look_up), frame, self._stack.attributes)
            self._detail.add(light[np.newaxis], wanted)

    def _read(self, rows: slice, columns: slice, wanted: NDArray[np.bool_]) -> dict[int, Codes]:
        """Count what is clipped in all frames, and return those that are looked at further."""
        chosen, tones = self._frames.chosen, [frame for frame, _ in self._frames.tones]
        further = (self._frames.black, self._frames.white, *tones, *self._frames.coloured)
        kept: dict[int, Codes] = {}
        for at, codes in _batches(self._stack, rows, columns, chosen):
            for end, there in enumerate((codes == 0, codes >= self._top)):
                # Channel by channel, which takes a ninth of the time of `any`.
                in_any = np.logical_or.reduce([there[..., c] for c in range(there.shape[3])])
                self._clipped[end, at] += np.count_nonzero(in_any & wanted, axis=(1, 2))
            found = dict(zip(chosen[at].tolist(), codes, strict=True))
            kept |= {frame: found[frame].copy() for frame in further if frame in found}
        return kept

    def figures(self, program: Program) -> dict[str, Any]:
        """What the report needs, as JSON."""
        contrast, middling, bright = (
            _percentile(values, q)
            for values, q in ((self._contrasts, 50), (self._deviations, 50), (self._brightest, 99))
        )
        pixels = max(self._pixels, 1)
        share = self._clipped[:, self._frames.is_pattern] / pixels
        apart = self._lit[0] / np.maximum(self._lit[1], 1e-12) - [level for _, level in self._frames.tones]
        return {
            "pixels": self._pixels,
            "black": {"clipped_low": self._ends[0, 0] / pixels},
            "white": {"clipped_high": self._ends[1, 1] / pixels, "reaches": bright},
            "patterns": {"clipped_low": float(share[0].mean()), "clipped_high": float(share[1].mean())},
            "contrast": contrast,
            "deviation": middling,
            "lost_colour": self._detail.lost() * (COLOURED if program.in_colour else 1),
            "grey": self._stack.channels == 1,
            "halftones_apart": float(apart[np.argmax(np.abs(apart))]) if self._lit.any() else None,
        }


def _halftone_frames(stack: Stack, program: Program) -> list[tuple[int, float]]:
    """A frame of each half-tone in the shortest exposure, and the share of white's light that it should have."""
    frames = [shortest_frames(stack.attributes, number) for number in program.halftones[0]]
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
