"""The backdrop around the glass: what was left out of a matte shows it, as the camera would see it there."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.errors import Conflict
from storage.layout.mattes import Matte
from workflows.composite.backdrops.backdrop import Backdrop, frame_light
from workflows.composite.backdrops.placement import Placement
from workflows.composite.engine import Window
from workflows.mattes.perspective import corners
from workflows.threads import CORES


def over_frame(matte: Matte, placement: Placement | None) -> Placement | None:
    """Where a backdrop stands that is placed over all that the frame sees, in place of the monitor.

    Parameters
    ----------
    matte : Matte
        If it does not know where the camera looks beside the object, the frame sees the monitor and no more.
    placement : Placement, optional

    Returns
    -------
    Placement
        None if it is stretched over the monitor.

    Notes
    -----
    It covers the monitor too, whose light the glass may bring from beyond the frame, and has the monitor's aspect.
    """
    beside = matte.attributes.get("beside")
    if beside is None:
        return placement
    seen = np.concatenate([corners(np.array(beside["sight"])), [[0, 0], [1, 1]]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    right, down = (low + high - 1) / 2
    covering = Placement(float(right), float(down), float((high - low).max()))
    return (placement or Placement()).within(covering)


def exposure(matte: Matte) -> NDArray[np.float64]:
    """From the light that the camera takes to that of the monitor beside the object, by channel.

    Returns
    -------
    (3, 3) float64
        The identity if the matte does not know how bright the bare monitor was.

    Notes
    -----
    The camera takes C = X (rho L) of the bare monitor, so this is the inverse of X diag(rho). Light that comes through
    clear glass has the colours of the backdrop beside it then.
    """
    beside = matte.attributes.get("beside")
    return np.linalg.inv(np.array(matte.attributes["crosstalk"]) * beside["rho"]) if beside else np.eye(3)


class Plate(NamedTuple):
    """How a plate of the frame, what the camera would see without the glass, stands for the backdrop.

    Attributes
    ----------
    place : (3, 3) float64
        The homography from the monitor to the frame, both from 0 to 1 across and down.
    exposure : (3, 3) float64
        See `exposure`.
    """

    place: NDArray[np.float64]
    exposure: NDArray[np.float64]


def plate_of(matte: Matte) -> Plate:
    """How a plate of a matte's frame stands for the backdrop.

    Raises
    ------
    Conflict
        If it is not known where the frame's pixels look beside the object, or the frame sees too little of the monitor.
    """
    if "beside" not in matte.attributes:
        raise Conflict(
            "where this matte's camera looks beside the object is not known, so it can't take a plate of the frame: "
            "recover it with cut_out from a capture without a mask, with some of the bare monitor in the frame"
        )
    place = np.linalg.inv(np.array(matte.attributes["beside"]["sight"]))
    try:
        corners(place)
    except ValueError:
        raise Conflict(
            "the frame sees too little of the monitor, or too much from the side, to show it a plate: film it with "
            "more of the monitor in the frame"
        ) from None
    return Plate(place, exposure(matte))


def expose(matte: Matte, picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give a composite, (h, w, 4) float32, the colours and the brightness of the backdrop; changed in place."""
    if "beside" in matte.attributes:
        picture[..., :3] = picture[..., :3] @ exposure(matte).T.astype(np.float32)
    return picture


def put_around(
    matte: Matte,
    backdrop: Backdrop,
    placement: Placement | None,
    picture: NDArray[np.float32],
    window: Window,
    threads: int = CORES,
) -> NDArray[np.float32]:
    """Put the backdrop where a composite is transparent.

    Parameters
    ----------
    matte : Matte
    backdrop : Backdrop
    placement : Placement, optional
        Where it stands, in the plane of the monitor.
    picture : (height, width, 4) float32
        Linear light and alpha of the window; changed in place.
    window : Window
    threads : int

    Returns
    -------
    (height, width, 4) float32
        The picture, opaque. Within a pixel of the edge both are mixed, so that it shows no steps.
    """
    alpha = picture[..., 3:]
    if (alpha == 1).all():
        return picture
    behind = frame_light(backdrop, matte.width, matte.height, threads, _seen(matte, placement))
    behind = behind[window.y : window.y + window.height, window.x : window.x + window.width]
    alpha = alpha * _blurred(alpha)
    picture[..., :3] *= alpha
    picture[..., :3] += (1 - alpha) * behind
    picture[..., 3] = 1
    return picture


def _seen(matte: Matte, placement: Placement | None) -> NDArray[np.float64] | None:
    """The homography from the frame to the backdrop; None if the frame sees all of it."""
    beside = matte.attributes.get("beside")
    if beside is None and placement is None:
        return None
    placed = (placement or Placement()).matrix(matte.attributes["monitor"])
    return placed if beside is None else placed @ beside["sight"]


def _blurred(alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mean over each pixel and its eight neighbours."""
    for axis in (0, 1):
        size = alpha.shape[axis]
        wide = np.pad(alpha, [(1, 1) if axis == other else (0, 0) for other in range(3)], mode="edge")
        before, at, after = (np.take(wide, range(k, k + size), axis) for k in range(3))
        alpha = (before + at + after) / np.float32(3)
    return alpha
