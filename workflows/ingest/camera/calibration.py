"""Calibrate the camera from constant frames: its noise, its crosstalk, and unknown tone curves."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import (
    CameraCurve,
    Response,
    light_of_codes,
    table,
    to_light,
)
from workflows.ingest.camera.border_exposure import TRIFLE, BorderValues, is_free, relative_to_white
from workflows.ingest.camera.curve import are_scaled, fit_camera_curve
from workflows.ingest.camera.curve_estimate import Estimate, estimate
from workflows.ingest.camera.lit import find_lit
from workflows.ingest.camera.sample import FRAMES, FilmedPixels, HalftoneCodes, Sample
from workflows.ingest.camera.stated_exposure import automatic_exposures
from workflows.ingest.light.local_gain import Surroundings, local_gain
from workflows.ingest.light.stack_attributes import (
    clipped_from,
    exposures_of,
    program_of,
    white_balance_of,
)
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel, estimate_excess
from workflows.recovery.camera.photometry import estimate_crosstalk, estimate_noise

CLIPS = 0.01
"""Share of the values of a film at full scale from which on it clips,"""
CLIPPED = 0.97
"""and the share of full scale from which on its values then count as clipped."""
TURNS = 4
"""Turns in which the camera's curve and a film's exposures are found, one given the other."""

_GREY = np.array([0.5], np.float32)


class ConstantFrames(NamedTuple):
    """Constant frames to measure from: one for each pattern and exposure, from dark to bright.

    Attributes
    ----------
    frames : list of int
        At most `FRAMES`.
    sent : (k, 3) float32
        Values sent to the monitor in each.
    exposures : (k,) float32
        In units of the stack's shortest.
    """

    frames: list[int]
    sent: NDArray[np.float32]
    exposures: NDArray[np.float32]

    @property
    def grey(self) -> NDArray[np.bool_]:
        """Which have no colour, (k,)."""
        grey: NDArray[np.bool_] = np.ptp(self.sent, axis=1) == 0
        return grey

    def only(self, at: NDArray[np.intp]) -> Self:
        """Some of them."""
        return self._replace(
            frames=[self.frames[n] for n in at], sent=self.sent[at], exposures=self.exposures[at]
        )


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
        Annotated with the results, but not saved. A ``white_balance`` that it has is undone.
    border : BorderValues, optional
        Of a film with a border.
    gains : sequence of float, optional
        Gain of the monitor's light in each frame; 1 by default.
    tone_mapping : dict, optional
        See `workflows.ingest.trial.tone_mapping`.
    """
    program = program_of(stack.attributes)
    sample = Sample(stack, find_lit(stack, program))
    filmed = sample.every_frame()
    stack.annotate(tone_mapping=tone_mapping, clipped_from=_clipped_from(stack, filmed))
    gain, balance = local_gain(stack), white_balance_of(stack.attributes)
    constants = constant_frames(stack, program)
    codes = np.ascontiguousarray(sample.codes(constants.frames).transpose(1, 0, 2))
    usable = (codes > 0) & (codes < clipped_from(stack))
    camera, exposed, scaled = _camera(stack, program, sample, border, gain, balance)
    curves = _estimate_curves(stack, program, camera, constants, codes, usable)
    camera = curves.camera if camera == "unknown" else camera
    # Only one exposure, so that all frames have the same noise.
    shortest = np.flatnonzero(constants.exposures == constants.exposures.min())
    constants, codes, usable = constants.only(shortest), codes[:, shortest], usable[:, shortest]
    top, black = np.iinfo(stack.dtype).max, stack.attributes["storage"]["black"]
    look_up = table(camera, stack.dtype, black)
    light, shown = light_of_codes(codes, look_up), to_light(constants.sent, curves.monitor)
    changed = np.ones((stack.frames, 1)) if exposed is None else exposed[:, np.newaxis]
    if balance is not None:
        changed = changed * balance
    light /= changed[constants.frames].astype(np.float32)
    if gain is not None:
        light /= gain.at(*sample.places)[constants.frames].T[..., np.newaxis]
    if gains is not None:
        shown *= np.array([gains[frame] for frame in constants.frames], np.float32)[:, np.newaxis]
    # Crosstalk between channels must not count as noise, so grey levels are used if there are enough.
    grey = constants.grey
    some = grey if np.count_nonzero(grey) >= 4 else np.ones_like(grey)
    noise = estimate_noise(light[:, some], shown[some], usable[:, some], 1 / (top - black))
    if filmed is not None and not is_free(exposed):
        whole = (filmed.codes > 0) & (filmed.codes < clipped_from(stack))
        compressed = _noise_of_film(
            filmed.light(look_up, gain, changed), whole, constants.frames, shown.mean(axis=1)
        )
        # Compression makes noise larger only.
        if compressed is not None and compressed.variance(_GREY) >= noise.variance(_GREY):
            noise = compressed
    stack.annotate(
        monitor_curve=_as_json(curves.monitor),
        camera_curve=_as_json(camera),
        assumed_curves=curves.assumed,
        scaled=scaled,
        auto_exposure=None if exposed is None else exposed.round(5).tolist(),
        noise={"read": noise.read, "shot": noise.shot},
        assumed_noise=bool((filmed is None and np.count_nonzero(some) < 4) or is_free(exposed)),
        crosstalk=estimate_crosstalk(light, shown, usable).tolist(),
    )


def _estimate_curves(
    stack: Stack,
    program: Program,
    camera: CameraCurve | Literal["unknown"],
    constants: ConstantFrames,
    codes: NDArray[Any],
    usable: NDArray[np.bool_],
) -> Estimate:
    """The unknown curves, by the grey ones of the constant frames, whose codes are (n, k, 3)."""
    grey = constants.grey
    known = "linear" if camera == "unknown" else camera
    return estimate(
        constants.sent[grey, 0],
        constants.exposures[grey],
        _by_value(
            light_of_codes(codes[:, grey], table(known, stack.dtype, stack.attributes["storage"]["black"]))
        ),
        _by_value(usable[:, grey]),
        program.monitor.response,
        "unknown" if camera == "unknown" else "linear",
    )


def _camera(
    stack: Stack,
    program: Program,
    sample: Sample,
    border: BorderValues | None,
    gain: Surroundings | None,
    balance: NDArray[np.float64] | None,
) -> tuple[CameraCurve | Literal["unknown"], NDArray[np.float64] | None, bool]:
    """The camera's curve, or that of each channel; the exposure of each frame by a film's border, or as stills state
    it, (frames,), if it varied; whether the monitor showed the patterns at another size.

    An unknown curve is measured if the program shows half-tones. It and the exposures are found in turn.
    """
    camera: CameraCurve | Literal["unknown"]
    camera = TypeAdapter[Response](Response).validate_python(stack.attributes["response"])
    stated = camera != "unknown"
    halftones = HalftoneCodes.of(stack, program, sample)
    exposed = automatic_exposures(stack.attributes.get("stated_exposures"))
    scaled = False
    for _ in range(TURNS if border else 1):
        before = camera
        look_up = table(
            "srgb" if camera == "unknown" else camera, stack.dtype, stack.attributes["storage"]["black"]
        )
        if border:
            exposed = border.exposures(look_up, gain, balance)
        seen = halftones and halftones.exposed(np.ones(stack.frames) if exposed is None else exposed)
        if stated:
            scaled = seen is not None and are_scaled(seen, look_up)
        elif seen:
            curve, scaled = fit_camera_curve(seen, stack.channels)
            camera = curve or "unknown"
        if camera == before:  # so is all that follows from it
            break
    if exposed is not None and np.log(exposed).std() < TRIFLE:
        exposed = None
    if exposed is not None and is_free(exposed):
        exposed = relative_to_white(exposed, stack.attributes["patterns"], program)
    return camera, exposed, scaled


def _clipped_from(stack: Stack, filmed: FilmedPixels | None) -> int:
    """The value from which on one counts as clipped.

    Compression, and averaging, make values of a little less than full scale of what was clipped.
    """
    top = int(np.iinfo(stack.dtype).max)
    clips = filmed is not None and filmed.codes.size and np.mean(filmed.codes == top) > CLIPS
    return int(CLIPPED * top) if clips else top


def _noise_of_film(
    light: NDArray[np.float32], usable: NDArray[np.bool_], constants: list[int], shown: NDArray[np.float32]
) -> NoiseModel | None:
    """The noise of a film's frames, which compression makes larger for patterns than for constant frames.

    Each mean frame counts as one frame, because averaging does not remove compression noise.

    Parameters
    ----------
    light : (n, frames, channels) float32
    usable : (n, frames, channels) bool
    constants : list of int
        The k constant frames.
    shown : (k,) float32
        The monitor's light in each of them.

    Returns
    -------
    NoiseModel or None
        See `estimate_excess`.
    """
    design = np.stack([np.ones(len(shown)), shown], axis=1)
    black, slope = np.einsum("dk,nkc->dnc", np.linalg.pinv(design), light[:, constants]).astype(np.float32)
    return estimate_excess(light, black, black + np.maximum(slope, 0), usable)


def constant_frames(stack: Stack, program: Program) -> ConstantFrames:
    """The constant frames of a stack to measure from; of more than `FRAMES`, some that are spread over them."""
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
    return ConstantFrames(
        [frame for _, _, frame in found],
        sent[[at for at, _, _ in found]],
        np.array([exposure for _, exposure, _ in found], np.float32),
    )


def _by_value(values: NDArray[Any]) -> NDArray[Any]:
    """Reorder (n, k, 3) to (k, 3 n)."""
    return values.transpose(1, 0, 2).reshape(values.shape[1], -1)


def _as_json(curve: CameraCurve) -> Any:
    return TypeAdapter(CameraCurve).dump_python(curve, mode="json")
