"""What ingest has noted in the attributes of a stack, as computations take it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import CameraCurve, Curve, table
from workflows.programs.program import Program

Floats = NDArray[np.float32]


def program_of(attributes: dict[str, Any]) -> Program:
    """What the monitor showed."""
    return Program.model_validate(attributes["program"])


def clipped_from(stack: Stack) -> int:
    """The value from which on one counts as clipped: full scale, or less in a film that clips."""
    return int(stack.attributes.get("clipped_from", np.iinfo(stack.dtype).max))


def look_up_of(stack: Stack) -> Floats:
    """A look-up table from the values of a stack to light, as of `workflows.images.tone_curves.table`."""
    camera = TypeAdapter[CameraCurve](CameraCurve).validate_python(stack.attributes["camera_curve"])
    return table(camera, stack.dtype, stack.attributes["storage"]["black"])


def monitor_curve_of(attributes: dict[str, Any]) -> Curve:
    """The monitor's curve, as stated or as calibration has found it."""
    curve: Curve = TypeAdapter[Curve](Curve).validate_python(attributes["monitor_curve"])
    return curve


def exposures_of(attributes: dict[str, Any]) -> Floats:
    """Exposure times of a stack's frames in units of the shortest, (frames,) float32."""
    exposures = np.array(attributes["exposures"], np.float32)
    exposures /= exposures.min()
    return exposures


def white_balance_of(attributes: dict[str, Any]) -> NDArray[np.float64] | None:
    """Gains of the channels in each frame, (frames, 3), as of `workflows.ingest.camera.white_balance`."""
    found = attributes.get("white_balance")  # missing from captures of earlier versions
    return None if found is None else np.array(found)


def shortest_frames(attributes: dict[str, Any], numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """The frames of some patterns in the shortest exposure."""
    return np.flatnonzero(np.isin(attributes["patterns"], numbers) & (exposures_of(attributes) == 1))


def odd_frames(attributes: dict[str, Any]) -> list[int]:
    """The frames of a stack that do not show their patterns, as `workflows.ingest.trial.frame_order` has found."""
    found: list[int] = attributes.get("odd_frames", [])  # missing from captures of earlier versions
    return found


def patterns_seen(attributes: dict[str, Any]) -> list[int]:
    """The patterns of a stack's frames, in order, without those of odd ones."""
    odd = set(odd_frames(attributes))
    return [pattern for frame, pattern in enumerate(attributes["patterns"]) if frame not in odd]
