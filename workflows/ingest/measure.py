"""What the frames of constant monitors say of the camera: its noise, its crosstalk, and curves that are unknown."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.captures import Stack
from storage.objects import Objects
from workflows.program import Program
from workflows.recovery.photometry import estimate_crosstalk, estimate_noise
from workflows.tone import Curve, Response, estimate, table, to_light

SAMPLES = 20_000
"""Pixels, about, from which the noise and unknown curves are measured."""


def measure(objects: Objects, capture: str) -> None:
    """Measure the noise, the crosstalk, and the curves that the capture calls unknown, from frames of constant levels.

    Raises
    ------
    Corrupt
        If part of the stack is missing.
    """
    stack = Stack(objects, capture)
    stack.check()
    program = Program.model_validate(stack.attributes["program"])
    patterns = np.array(stack.attributes["patterns"])
    numbers, sent = program.constants
    codes = np.stack([_sample(stack, int(np.flatnonzero(patterns == n)[0])) for n in numbers], axis=1)
    top = np.iinfo(stack.dtype).max
    usable = (codes > 0) & (codes < top)

    whole = usable.all(axis=(1, 2))
    values = codes[whole].astype(np.float32) / np.float32(top)
    grey = np.ptp(sent, axis=1) == 0
    monitor, camera = estimate(
        sent[grey, 0],
        values[:, grey].transpose(1, 0, 2).reshape(int(grey.sum()), -1),
        program.monitor.response,
        TypeAdapter(Response).validate_python(stack.attributes["response"]),
    )
    look_up = table(camera, stack.dtype)
    light, shown = look_up[codes], to_light(sent, monitor)
    # what the channels see of each other's colours is no noise
    some = grey if np.count_nonzero(grey) >= 4 else np.ones_like(grey)
    noise = estimate_noise(light[:, some], shown[some], usable[:, some], 1 / top)
    stack.annotate(
        monitor_curve=_plain(monitor),
        camera_curve=_plain(camera),
        noise={"read": noise.read, "shot": noise.shot},
        crosstalk=estimate_crosstalk(light, shown, usable).tolist(),
    )


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
