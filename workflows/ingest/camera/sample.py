"""The pixels that a camera is calibrated by: spread over those that see the monitor, and read in few chunks."""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import light_of_codes
from workflows.ingest.camera.border_exposure import is_free
from workflows.ingest.camera.curve import HalfTones, Shown
from workflows.ingest.camera.lit import windows
from workflows.ingest.light.local_gain import Surroundings, local_gain
from workflows.ingest.light.stack_attributes import shortest_frames, white_balance_of
from workflows.programs.program import Program

SAMPLES = 20_000
"""About how many pixels the noise and unknown curves are measured from."""
FRAMES = 64
"""At most how many constant frames they are measured from."""
COMPRESSED_SAMPLES = 4096
"""At most how many pixels of all frames the noise of a video is measured from."""


class Sample:
    """Pixels spread over those that see the monitor, in short runs so that few chunks are read.

    Attributes
    ----------
    places : (2, n) intp
        Their rows and columns.
    """

    def __init__(self, stack: Stack, seen: NDArray[np.bool_]) -> None:
        self._stack, self._seen = stack, seen
        self._squares = windows(seen, int(SAMPLES**0.5) // 4)
        # A film is measured by every frame: its squares are read once.
        self._filmed = (
            [stack.read(*square) for square in self._squares] if "video" in stack.attributes else None
        )
        self.places = np.concatenate([_places(square, seen[square]) for square in self._squares], axis=1)

    def codes(self, frames: list[int]) -> NDArray[Any]:
        """Values of frames, (frames, n, 3)."""
        if self._filmed is None:
            read = [self._stack.read_frames(frames, *square) for square in self._squares]
        else:
            read = [values[frames] for values in self._filmed]
        parts = [values[:, self._seen[square]] for values, square in zip(read, self._squares, strict=True)]
        pixels = np.concatenate(parts, axis=1)
        return np.broadcast_to(pixels, (*pixels.shape[:2], 3))

    def every_frame(self) -> "FilmedPixels | None":
        """Some of the pixels to recover, in all frames; None unless it is a film."""
        if self._filmed is None:
            return None
        chosen = [self._stack.mask(*square) & self._seen[square] for square in self._squares]
        codes = np.concatenate(
            [values[:, some] for values, some in zip(self._filmed, chosen, strict=True)], axis=1
        ).transpose(1, 0, 2)
        places = np.concatenate([_places(*one) for one in zip(self._squares, chosen, strict=True)], axis=1)
        step = -(-len(codes) // COMPRESSED_SAMPLES) or 1
        return FilmedPixels(codes[::step], places[:, ::step])


class FilmedPixels(NamedTuple):
    """Pixels in all frames of a film.

    Attributes
    ----------
    codes : (n, frames, channels) uint16
    places : (2, n) intp
        Their rows and columns.
    """

    codes: Codes
    places: NDArray[np.intp]

    def light(
        self, look_up: NDArray[np.float32], gain: Surroundings | None, changed: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Their light, without local gain and what else has ``changed``, (frames, 1 or channels), like the codes."""
        light = light_of_codes(self.codes, look_up)
        if gain is not None:
            light /= gain.at(*self.places).T[..., np.newaxis]
        light /= changed.astype(np.float32)
        return light


def _places(square: tuple[slice, slice], chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Rows and columns of the chosen pixels of a square, (2, n)."""
    places: NDArray[np.intp] = np.stack(np.nonzero(chosen)) + np.array([[part.start] for part in square])
    return places


class HalftoneCodes(NamedTuple):
    """What a sample of the pixels shows of black, of white, and of half-tones.

    Attributes
    ----------
    frames : list of (k,) intp
        The frames of black, of white, and of each half-tone, in the shortest exposure; at most `FRAMES` of each.
    codes : list of (k, n) float32
        Values of n pixels and channels in each of them, 0 to 1.
    gain : (frames, n) float64 or None
        The local gain, and that of the white balance, in all frames of the stack.
    shares : list of float
        The share of white's light that each half-tone has.
    """

    frames: list[NDArray[np.intp]]
    codes: list[NDArray[np.float32]]
    gain: NDArray[np.float64] | None
    shares: list[float]

    @classmethod
    def of(cls, stack: Stack, program: Program, sample: Sample) -> Self | None:
        """Those of a stack; None if the program shows no half-tones, or black or white is missing."""

        def frames_of(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
            return shortest_frames(stack.attributes, numbers)[:FRAMES]

        constants, sent = program.constants_among(stack.attributes["patterns"])
        ends = [frames_of(constants[(sent == level).all(axis=1)]) for level in (0, 1)]
        tones = [(frames_of(number), float(share)) for number, share in zip(*program.halftones, strict=True)]
        tones = [(some, share) for some, share in tones if some.size]
        if not tones or not all(some.size for some in ends):
            return None
        frames = ends + [some for some, _ in tones]
        every = np.concatenate(frames)
        full = np.float32(np.iinfo(stack.dtype).max)
        values = sample.codes(every.tolist()).reshape(every.size, -1).astype(np.float32) / full
        local, balance = local_gain(stack), white_balance_of(stack.attributes)
        gain = None if local is None else np.repeat(local.at(*sample.places), 3, axis=1).astype(np.float64)
        if balance is not None:
            gain = (1.0 if gain is None else gain) * np.tile(balance, sample.places.shape[1])
        return cls(
            frames,
            np.split(values, np.cumsum([some.size for some in frames])[:-1]),
            gain,
            [share for _, share in tones],
        )

    def exposed(self, exposures: NDArray[np.float64]) -> HalfTones | None:
        """The half-tones, given the exposure of each frame of the stack; None if it was not locked."""
        if is_free(exposures[np.concatenate(self.frames)]):
            return None
        black, white, *tones = (
            Shown(codes, exposures[some, np.newaxis] * (1.0 if self.gain is None else self.gain[some]))
            for codes, some in zip(self.codes, self.frames, strict=True)
        )
        return HalfTones(black, white, tones, self.shares)
