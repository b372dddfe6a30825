"""Local tone mapping of a camera: a gain that is the less, the brighter a frame is around a place."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack, thumbnail_edge
from workflows.images.resample import between_samples

DARK = 0.05
"""Brightness below which a camera brightens hardly further."""
DISPLAY = 1 / 2.2
"""Brightness is linear light to this power."""

Floats = NDArray[np.float32]
Places = NDArray[np.integer]


class Surroundings(NamedTuple):
    """A function of how bright the frames of a stack are around each place.

    Attributes
    ----------
    values : (frames, rows, columns) float32
        At the centres of blocks.
    edge : int
        Edge of a block in pixels.
    """

    values: Floats
    edge: int

    def at(self, y: Places, x: Places, frames: int | slice = slice(None)) -> Floats:
        """The values at n pixels of one frame, (n,), or of several, (frames, n) float32.

        They are interpolated between blocks, and depend on nothing but frame and pixel.
        """
        rows, columns = self.values.shape[1:]
        (top, bottom, down), (left, right, across) = (
            between_samples((place + 0.5) / self.edge - 0.5, size)
            for place, size in ((y, rows), (x, columns))
        )
        of_frames = self.values[frames]
        upper, lower = (
            of_frames[..., row, left] * (1 - across) + of_frames[..., row, right] * across
            for row in (top, bottom)
        )
        return np.asarray(upper * (1 - down) + lower * down, np.float32)


def surroundings(stack: Stack, width: float) -> Surroundings | None:
    """The logarithm of the brightness around each place, plus `DARK`; None in captures of earlier versions.

    Parameters
    ----------
    stack : Stack
    width : float
        Standard deviation of the Gaussian that the brightness is a mean by, as a share of the frame's width.
    """
    from scipy.ndimage import gaussian_filter  # takes long to import, and few processes need it

    thumbnails = stack.thumbnails()
    if thumbnails is None:
        return None
    brightness = thumbnails.astype(np.float32) / 65535
    if stack.attributes["response"] == "linear":
        black = np.float32(stack.attributes["storage"]["black"] / np.iinfo(stack.dtype).max)
        brightness = np.maximum(brightness - black, 0) ** np.float32(DISPLAY)
    edge = thumbnail_edge(stack.height, stack.width)
    sigma = width * stack.width / edge
    near = gaussian_filter(brightness, (0, sigma, sigma), mode="nearest")
    return Surroundings(np.log(near + np.float32(DARK)), edge)


def local_gain(stack: Stack) -> Surroundings | None:
    """The gain of the camera at each place of each frame, if `workflows.ingest.trial.tone_mapping` has found one.

    Notes
    -----
    With brightness m around a place, the gain is ``((m + c) / (u + c))^-p``, u being the usual brightness.
    """
    found = stack.attributes.get("tone_mapping")
    if not found:
        return None
    near = surroundings(stack, found["width"])
    if near is None:
        return None
    return near._replace(
        values=np.exp(np.float32(-found["power"]) * (near.values - np.float32(found["usual"])))
    )
