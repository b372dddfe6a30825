"""Convert composites to integers: exactly rounded under the tone curve, without computing a power for each pixel."""

from functools import cache
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import to_light
from workflows.threads import in_parts

STEPS = 1 << 14
"""Entries of the look-up table that gives a code close to the right one."""
ROWS = 64


def encode(
    picture: NDArray[np.float32],
    transfer: Literal["srgb", "linear"],
    dtype: np.dtype[np.unsignedinteger],
    threads: int,
    channels: Literal[3, 4] = 4,
) -> Codes:
    """Encode a picture as unsigned integers, clipped to 0 to 1 and rounded.

    Parameters
    ----------
    picture : (h, w, 4) float32
        Linear light and alpha.
    transfer : str
        Tone curve of the colours; alpha is linear.
    dtype : numpy.dtype
        uint8 or uint16.
    threads : int
        Threads to use.
    channels : int
        3 leaves alpha out.

    Returns
    -------
    (h, w, channels) uint8 or uint16
    """
    edges, first = _edges(transfer, dtype)
    codes = np.empty((*picture.shape[:2], channels), dtype)
    in_parts(
        lambda start: _encode(picture[start : start + ROWS], edges, first, codes[start : start + ROWS]),
        range(0, len(picture), ROWS),
        threads,
    )
    return codes


@cache
def _edges(
    transfer: Literal["srgb", "linear"], dtype: np.dtype[np.unsignedinteger]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The light at which each code ends and the next begins, and the code at each of `STEPS` + 1 values of light."""
    top = np.iinfo(dtype).max
    halves = (np.arange(top, dtype=np.float64) + 0.5) / top
    edges = np.append(to_light(halves, transfer), np.inf).astype(np.float32)  # type: ignore[arg-type]
    return edges, np.searchsorted(edges, np.arange(STEPS + 1, dtype=np.float32) / STEPS, side="right")


@njit(nogil=True, cache=True)
def _encode(
    picture: NDArray[np.float32],
    edges: NDArray[np.float32],
    first: NDArray[np.int64],
    codes: NDArray[np.unsignedinteger],
) -> None:
    height, width, channels = codes.shape
    steps, top = np.float32(first.size - 1), edges.size - 1
    for y in range(height):
        for x in range(width):
            for c in range(3):
                value = picture[y, x, c]
                if not value > 0:  # NaN as well
                    codes[y, x, c] = 0
                elif value >= 1:
                    codes[y, x, c] = top
                else:
                    code = first[int(value * steps)]
                    while value >= edges[code]:
                        code += 1
                    codes[y, x, c] = code
            if channels == 4:
                codes[y, x, 3] = round(picture[y, x, 3] * top)
