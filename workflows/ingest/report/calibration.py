"""What the frames of constant monitors say of the camera: its noise, its crosstalk, and curves that are unknown."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve, Response, estimate, table, to_light
from workflows.ingest.measured_light import exposures_of
from workflows.programs.program import Program
from workflows.recovery.compression_noise import estimate_excess
from workflows.recovery.noise import Noise
from workflows.recovery.photometry import estimate_crosstalk, estimate_noise

SAMPLES = 20_000
"""Pixels, about, from which the noise and unknown curves are measured."""
FRAMES = 64
"""Frames of constant levels, at most, from which they are."""

COMPRESSED_SAMPLES = 4096
"""Pixels, at most, from which the noise of a video is measured, in all of its frames."""


def measure(stack: Stack, gains: Sequence[float] | None = None) -> None:
    """Measure the noise, the crosstalk, and the curves that the capture calls unknown, from frames of constant levels.

    Parameters
    ----------
    stack : Stack
        It is annotated with what was found, and not saved.
    gains : sequence of float, optional
        Of the monitor's light in each frame; 1 if left out.
    """
    program = Program.model_validate(stack.attributes["program"])
    frames, sent, exposures = constant_frames(stack, program)
    codes = np.stack([_sample(stack, frame) for frame in frames], axis=1)
    top, black = np.iinfo(stack.dtype).max, stack.attributes["storage"]["black"]
    usable = (codes > 0) & (codes < top)
    grey = np.ptp(sent, axis=1) == 0
    found = estimate(
        sent[grey, 0],
        exposures[grey],
        _by_value(table("linear", stack.dtype, black)[codes[:, grey]]),
        _by_value(usable[:, grey]),
        program.monitor.response,
        TypeAdapter(Response).validate_python(stack.attributes["response"]),
    )
    # Of one exposure, so that they have one noise.
    shortest = np.flatnonzero(exposures == exposures.min())
    codes, usable, sent, grey = codes[:, shortest], usable[:, shortest], sent[shortest], grey[shortest]
    look_up = table(found.camera, stack.dtype, black)
    light, shown = look_up[codes], to_light(sent, found.monitor)
    if gains is not None:
        shown *= np.array([gains[frames[at]] for at in shortest], np.float32)[:, np.newaxis]
    # what the channels see of each other's colours is no noise
    some = grey if np.count_nonzero(grey) >= 4 else np.ones_like(grey)
    noise = estimate_noise(light[:, some], shown[some], usable[:, some], 1 / (top - black))
    if "video" in stack.attributes:
        noise = _compressed(stack, look_up, frames, shown, noise)
    stack.annotate(
        monitor_curve=_plain(found.monitor),
        camera_curve=_plain(found.camera),
        assumed_curves=found.assumed,
        noise={"read": noise.read, "shot": noise.shot},
        crosstalk=estimate_crosstalk(light, shown, usable).tolist(),
    )


def _compressed(
    stack: Stack,
    look_up: NDArray[np.float32],
    constants: Sequence[int],
    shown: NDArray[np.float32],
    noise: Noise,
) -> Noise:
    """The noise of a video's frames, which compression makes larger before patterns than before constants.

    Every frame counts as one, whatever went into its mean: what compression does is not averaged away.
    """
    squares = product(_spread(stack.height), _spread(stack.width))
    read = [stack.read_masked(y, x) for y, x in squares]
    codes = np.concatenate([values[:, mask] for values, mask in read], axis=1).transpose(1, 0, 2)
    codes = codes[:: -(-len(codes) // COMPRESSED_SAMPLES) or 1]
    light = look_up[codes]
    design = np.stack([np.ones(len(shown)), shown.mean(axis=1)], axis=1)
    black, slope = np.einsum("dk,nkc->dnc", np.linalg.pinv(design), light[:, constants]).astype(np.float32)
    usable = (codes > 0) & (codes < len(look_up) - 1)
    excess = estimate_excess(light, black, black + np.maximum(slope, 0), usable)
    grey = np.array([0.5], np.float32)
    return noise if excess is None or excess.variance(grey) < noise.variance(grey) else excess


def constant_frames(
    stack: Stack, program: Program
) -> tuple[list[int], NDArray[np.float32], NDArray[np.float32]]:
    """Frames of constant levels to measure by: one a pattern and exposure, from dark to bright.

    Returns
    -------
    frames : list of int
        `FRAMES` of them at most.
    sent : (k, 3) float32
        What the monitor showed in each.
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
    """(k, 3 n) of (n, k, 3)."""
    return values.transpose(1, 0, 2).reshape(values.shape[1], -1)


def _sample(stack: Stack, frame: int) -> NDArray[Any]:
    """(n, 3) values of a frame at pixels spread over it: whole chunks, so that few are read."""
    rows, columns = (_spread(n) for n in (stack.height, stack.width))
    parts = [
        stack.read(y, x, slice(frame, frame + 1)).reshape(-1, stack.channels) for y in rows for x in columns
    ]
    pixels = np.concatenate(parts)
    return np.broadcast_to(pixels, (len(pixels), 3))


def _spread(n: int) -> list[slice]:
    """At most four short runs of pixels, spread over n."""
    length = max(1, min(n // 4, int(SAMPLES**0.5) // 4))
    return [slice(start, start + length) for start in sorted({n * k // 4 for k in range(4)})]


def _plain(curve: Curve) -> Any:
    return TypeAdapter(Curve).dump_python(curve, mode="json")
