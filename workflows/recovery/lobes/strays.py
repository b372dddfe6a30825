"""Light that changes from frame to frame but does not come from the patterns, as of the border of a film."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

STRAY = 0.03
"""Prior standard deviation of an amount of stray light that is not constant, in units of T."""


@njit(nogil=True, cache=True)
def add_strays(
    strays: NDArray[np.float32], amount: NDArray[np.float64], first: int, f: NDArray[np.float32]
) -> None:
    """Write stray light from the given row of `strays` on, in the given amounts.

    Parameters
    ----------
    strays : (s, m + 2) float32
    amount : (groups s or more,) float64
    first : int
    f : (groups (m + 2),) float32
        Written.
    """
    count, size = strays.shape
    for g in range(f.size // size):
        of_group = f[g * size : (g + 1) * size]
        of_group[:] = 0
        for s in range(first, count):
            share = np.float32(amount[g * count + s])
            for j in range(size):
                of_group[j] += share * strays[s, j]


# With types, since it is called by a kernel and by itself: see `workflows.recovery.solvers`.
@njit("void(float32[::1], float32[::1], float32[::1], int64)", nogil=True, cache=True)
def subtract_strays(
    y: NDArray[np.float32], variance: NDArray[np.float32], stray: NDArray[np.float32], size: int
) -> None:
    """Subtract stray light from measurements, and normalise what is left so that black is -1 and white 1 again.

    Parameters
    ----------
    y, variance : (groups size,) float32
        Changed in place. The last two values of each group are those of a black and a white monitor.
    stray : (groups size,) float32
    size : int
        Measurements of a group.
    """
    for first in range(0, y.size, size):
        black = y[first + size - 2] - stray[first + size - 2]
        white = y[first + size - 1] - stray[first + size - 1]
        scale = np.float32(2) / max(white - black, np.float32(0.1))
        for j in range(first, first + size):
            y[j] = (y[j] - stray[j] - black) * scale - 1
            variance[j] *= scale**2
