"""Calibrate the camera from constant frames: its noise, its crosstalk, and unknown tone curves."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import CameraCurve, Response, estimate, light_of_codes, table, to_light
from workflows.ingest.camera.border_exposure import TRIFLE, BorderValues, relative_to_white
from workflows.ingest.camera.curve import HalfTones, Shown, are_scaled, fit_camera_curve
from workflows.ingest.camera.lit import find_lit, windows
from workflows.ingest.local_gain import Surroundings, local_gain
from workflows.ingest.measured_light import clipped_from, exposures_of
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel, estimate_excess
from workflows.recovery.camera.photometry import estimate_crosstalk, estimate_noise

SAMPLES = 20_000
"""About how many pixels the noise and unknown curves are measured from."""
FRAMES = 64
"""At most how many constant frames they are measured from."""
CLIPS = 0.01
"""Share of the values of a film at full scale from which on it clips,"""
CLIPPED = 0.97
"""and the share of full scale from which on its values then count as clipped."""
TURNS = 4
"""Turns in which the camera's curve and a film's exposures are found, one given the other."""
MOST_APART = 1.3
"""Ratio of the exposures of the constant frames from which on they tell no curve: the camera was not locked."""
COMPRESSED_SAMPLES = 4096
"""At most how many pixels of all frames the noise of a video is measured from."""


class _Sample:
    """Pixels spread over those that see the monitor, in short runs so that few chunks are read.

    Attributes
    ----------
    places : (2, n) intp
        Their rows and columns.
    """

    def __init__(self, stack: Stack, seen: NDArray[np.bool_]) -> None:
        self._stack, self._seen = stack, seen
        self._squares = windows(seen, int(SAMPLES**0.5) // 4)
        self.places = np.concatenate([_places(square, seen[square]) for square in self._squares], axis=1)

    def codes(self, frames: list[int]) -> NDArray[Any]:
        """Values of frames, (frames, n, 3)."""
        parts = [self._stack.read_frames(frames, *square)[:, self._seen[square]] for square in self._squares]
        pixels = np.concatenate(parts, axis=1)
        return np.broadcast_to(pixels, (*pixels.shape[:2], 3))

    def every_frame(self) -> tuple[Codes, NDArray[np.intp]]:
        """Values of some of the pixels to recover in all frames, (n, frames, channels), and their places, (2, n)."""
        read = [self._stack.read_masked(*square) for square in self._squares]
        chosen = [mask & self._seen[square] for square, (_, mask) in zip(self._squares, read, strict=True)]
        codes = np.concatenate(
            [values[:, some] for (values, _), some in zip(read, chosen, strict=True)], axis=1
        ).transpose(1, 0, 2)
        places = np.concatenate([_places(*one) for one in zip(self._squares, chosen, strict=True)], axis=1)
        step = -(-len(codes) // COMPRESSED_SAMPLES) or 1
        return codes[::step], places[:, ::step]


def _places(square: tuple[slice, slice], chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Rows and columns of the chosen pixels of a square, (2, n)."""
    places: NDArray[np.intp] = np.stack(np.nonzero(chosen)) + np.array([[part.start] for part in square])
    return places


def calibrate(
    stack: Stack,
    border: BorderValues | None = None,
    gains: Sequence[float] | None = None,
    tone_mapping: dict[str, float] | None = None,
) -> None:
    """Measure noise, crosstalk and unknown curves from the constant frames of a stack.

    Parameters
    ----------
    stack : Stack
        Annotated with the results, but not saved.
    border : BorderValues, optional
        Of a film with a border.
    gains : sequence of float, optional
        Gain of the monitor's light in each frame; 1 by default.
    tone_mapping : dict, optional
        See `workflows.ingest.trial.tone_mapping`.
    """
    program = Program.model_validate(stack.attributes["program"])
    sample = _Sample(stack, find_lit(stack, program))
    filmed = sample.every_frame() if "video" in stack.attributes else None
    stack.annotate(
        tone_mapping=tone_mapping, clipped_from=_clipped_from(stack, None if filmed is None else filmed[0])
    )
    gain = local_gain(stack)
    frames, sent, exposures = constant_frames(stack, program)
    codes = np.ascontiguousarray(sample.codes(frames).transpose(1, 0, 2))
    top, black = np.iinfo(stack.dtype).max, stack.attributes["storage"]["black"]
    usable = (codes > 0) & (codes < clipped_from(stack))
    grey = np.ptp(sent, axis=1) == 0
    camera, exposed, scaled = _camera(stack, program, sample, border, gain)
    known = "linear" if camera == "unknown" else camera
    found = estimate(
        sent[grey, 0],
        exposures[grey],
        _by_value(light_of_codes(codes[:, grey], table(known, stack.dtype, black))),
        _by_value(usable[:, grey]),
        program.monitor.response,
        "unknown" if camera == "unknown" else "linear",
    )
    if camera == "unknown":
        camera = found.camera
    # Only one exposure, so that all frames have the same noise.
    shortest = np.flatnonzero(exposures == exposures.min())
    codes, usable, sent, grey = codes[:, shortest], usable[:, shortest], sent[shortest], grey[shortest]
    look_up = table(camera, stack.dtype, black)
    light, shown = light_of_codes(codes, look_up), to_light(sent, found.monitor)
    if exposed is not None:
        light /= exposed[[frames[at] for at in shortest], np.newaxis].astype(np.float32)
    if gain is not None:
        light /= gain.at(*sample.places)[[frames[at] for at in shortest]].T[..., np.newaxis]
    if gains is not None:
        shown *= np.array([gains[frames[at]] for at in shortest], np.float32)[:, np.newaxis]
    # Crosstalk between channels must not count as noise, so grey levels are used if there are enough.
    some = grey if np.count_nonzero(grey) >= 4 else np.ones_like(grey)
    noise = estimate_noise(light[:, some], shown[some], usable[:, some], 1 / (top - black))
    if filmed is not None and not is_free(exposed):
        noise = _compressed(stack, *filmed, look_up, gain, exposed, frames, shown, noise)
    stack.annotate(
        monitor_curve=_as_json(found.monitor),
        camera_curve=_as_json(camera),
        assumed_curves=found.assumed,
        scaled=scaled,
        auto_exposure=None if exposed is None else exposed.round(5).tolist(),
        noise={"read": noise.read, "shot": noise.shot},
        assumed_noise=bool((filmed is None and np.count_nonzero(some) < 4) or is_free(exposed)),
        crosstalk=estimate_crosstalk(light, shown, usable).tolist(),
    )


def _camera(
    stack: Stack,
    program: Program,
    sample: _Sample,
    border: BorderValues | None,
    gain: Surroundings | None,
) -> tuple[CameraCurve | Literal["unknown"], NDArray[np.float64] | None, bool]:
    """The camera's curve, or that of each channel; the exposure of each frame of a film by its border, (frames,), if it
    varied; whether the monitor showed the patterns at another size.

    An unknown curve is measured if the program shows half-tones. It and the exposures are found in turn.
    """
    camera: CameraCurve | Literal["unknown"]
    camera = TypeAdapter[Response](Response).validate_python(stack.attributes["response"])
    stated = camera != "unknown"
    halftones = _halftones(stack, program, sample)
    exposed: NDArray[np.float64] | None = None
    scaled = False
    for _ in range(TURNS if border else 1):
        look_up = table(
            "srgb" if camera == "unknown" else camera, stack.dtype, stack.attributes["storage"]["black"]
        )
        if border:
            exposed = border.exposures(look_up, gain)
        seen = halftones(np.ones(stack.frames) if exposed is None else exposed) if halftones else None
        if stated:
            scaled = seen is not None and are_scaled(seen, look_up)
        elif seen:
            curve, scaled = fit_camera_curve(seen, stack.channels)
            camera = curve or "unknown"
    if exposed is not None and np.log(exposed).std() < TRIFLE:
        exposed = None
    if exposed is not None and is_free(exposed):
        exposed = relative_to_white(exposed, stack.attributes["patterns"], program)
    return camera, exposed, scaled


def is_free(exposed: Sequence[float] | NDArray[np.float64] | None) -> bool:
    """Whether the exposure of a film was not locked.

    Then errors of the exposures make more values brighter than white than noise does.
    """
    return exposed is not None and bool(np.max(exposed) > MOST_APART * np.min(exposed))


def _halftones(
    stack: Stack, program: Program, sample: _Sample
) -> Callable[[NDArray[np.float64]], HalfTones | None] | None:
    """A function from the exposures of all frames to half-tones; None if the program shows none.

    It returns None if the exposure was not locked.
    """
    times, patterns = exposures_of(stack.attributes), np.array(stack.attributes["patterns"])
    full = np.float32(np.iinfo(stack.dtype).max)

    def frames_of(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
        return np.flatnonzero(np.isin(patterns, numbers) & (times == times.min()))[:FRAMES]

    numbers, shares = program.halftones
    constants, sent = program.constants_among(stack.attributes["patterns"])
    of_light = [frames_of(constants[(sent == level).all(axis=1)]) for level in (0, 1)]
    there = [(frames_of(number), float(share)) for number, share in zip(numbers, shares, strict=True)]
    there = [(frames, share) for frames, share in there if frames.size]
    if not there or not all(frames.size for frames in of_light):
        return None
    of_light += [frames for frames, _ in there]
    gain = local_gain(stack)
    local = None if gain is None else np.repeat(gain.at(*sample.places), 3, axis=1).astype(np.float64)
    values = sample.codes(np.concatenate(of_light).tolist()).reshape(sum(map(len, of_light)), -1)
    codes = np.split(values.astype(np.float32) / full, np.cumsum([len(frames) for frames in of_light])[:-1])

    def seen(exposed: NDArray[np.float64]) -> HalfTones | None:
        used = exposed[np.concatenate(of_light)]
        if used.max() > MOST_APART * used.min():
            return None
        black, white, *tones = (
            Shown(part, exposed[frames, np.newaxis] * (1.0 if local is None else local[frames]))
            for part, frames in zip(codes, of_light, strict=True)
        )
        return HalfTones(black, white, tones, [share for _, share in there])

    return seen


def _clipped_from(stack: Stack, filmed: Codes | None) -> int:
    """The value from which on one counts as clipped.

    Compression, and averaging, make values of a little less than full scale of what was clipped.
    """
    top = int(np.iinfo(stack.dtype).max)
    clips = filmed is not None and filmed.size and np.mean(filmed == top) > CLIPS
    return int(CLIPPED * top) if clips else top


def _compressed(
    stack: Stack,
    filmed: Codes,
    places: NDArray[np.intp],
    look_up: NDArray[np.float32],
    gain: Surroundings | None,
    exposed: NDArray[np.float64] | None,
    constants: Sequence[int],
    shown: NDArray[np.float32],
    noise: NoiseModel,
) -> NoiseModel:
    """The noise of a video's frames, which compression makes larger for patterns than for constant frames.

    Each mean frame counts as one frame, because averaging does not remove compression noise.
    """
    light = light_of_codes(filmed, look_up)
    if gain is not None:
        light /= gain.at(*places).T[..., np.newaxis]
    if exposed is not None:
        light /= exposed[:, np.newaxis].astype(np.float32)
    design = np.stack([np.ones(len(shown)), shown.mean(axis=1)], axis=1)
    black, slope = np.einsum("dk,nkc->dnc", np.linalg.pinv(design), light[:, constants]).astype(np.float32)
    usable = (filmed > 0) & (filmed < clipped_from(stack))
    excess = estimate_excess(light, black, black + np.maximum(slope, 0), usable)
    grey = np.array([0.5], np.float32)
    return noise if excess is None or excess.variance(grey) < noise.variance(grey) else excess


def constant_frames(
    stack: Stack, program: Program
) -> tuple[list[int], NDArray[np.float32], NDArray[np.float32]]:
    """Constant frames to measure from: one for each pattern and exposure, from dark to bright.

    Returns
    -------
    frames : list of int
        At most `FRAMES`.
    sent : (k, 3) float32
        Values sent to the monitor in each.
    exposures : (k,) float32
        In units of the stack's shortest.
    """
    exposures = exposures_of(stack.attributes)
    numbers, sent = program.constants
    first: dict[tuple[int, float], int] = {}
    for frame, key in enumerate(zip(stack.attributes["patterns"], exposures.tolist(), strict=True)):
        first.setdefault(key, frame)
    place = {int(number): at for at, number in enumerate(numbers)}
    found = [
        (place[pattern], exposure, frame) for (pattern, exposure), frame in first.items() if pattern in place
    ]
    found.sort(key=lambda f: (f[1], float(sent[f[0]].sum()), f[2]))
    if len(found) > FRAMES:
        found = [found[at] for at in np.linspace(0, len(found) - 1, FRAMES).astype(int)]
    return (
        [frame for _, _, frame in found],
        sent[[at for at, _, _ in found]],
        np.array([exposure for _, exposure, _ in found], np.float32),
    )


def _by_value(values: NDArray[Any]) -> NDArray[Any]:
    """Reorder (n, k, 3) to (k, 3 n)."""
    return values.transpose(1, 0, 2).reshape(values.shape[1], -1)


def _as_json(curve: CameraCurve) -> Any:
    return TypeAdapter(CameraCurve).dump_python(curve, mode="json")
