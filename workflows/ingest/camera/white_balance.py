"""How the white balance of a camera changed from frame to frame, by the colours of black-and-white patterns."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from workflows.programs.program import Program
from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA

NEAR = 9
"""Frames whose median a white balance is."""
LEAST, SURE = 0.01, 4.0
"""It has changed if its deviation, of logarithms, is larger, and so many times that of what single frames differ by."""
CONTRAST = 0.1
"""Share of the median contrast that a pixel needs in each channel, and of the median light that a frame needs."""
FEWEST = 16
"""Frames of patterns that are needed."""

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def fit_white_balance(
    light: Floats,
    whole: NDArray[np.bool_],
    patterns: NDArray[np.intp],
    program: Program,
    known: Doubles | None = None,
) -> Doubles | None:
    """The gain of each channel in each frame, in units of those it began with, green's being 1.

    Parameters
    ----------
    light : (frames, n, 3) float32
        Of n pixels that see the monitor; what is known is undone.
    whole : (frames, n, 3) bool
        What is not clipped.
    patterns : (frames,) int
        What each frame shows.
    program : Program
        In black and white.
    known : (frames, 3) float64, optional
        What was found before, by curves that were measured without it.

    Returns
    -------
    (frames, 3) float64 or None
        None if the white balance has not changed, or can't be measured.

    Notes
    -----
    What a pixel sees of a black-and-white pattern, ``(C - S) / rho``, is the same share of white in all channels but
    for dispersion, which many pixels average. So the ratio of its sums over pixels, of two channels, is that of their
    gains, whatever exposure, tone mapping or sharpening make of the frame. Cameras change the white balance in steps or
    slowly: the median of neighbouring frames is less noisy, and does not blur a step. Constant frames have the gains of
    the patterns beside them, since some are coloured.
    """
    numbers, sent = program.constants
    black, white, shown = (
        np.isin(patterns, some)
        for some in (program.black, numbers[(sent == 1).all(axis=1)], program.measured)
    )
    if not (black.any() and white.any() and shown.any()):
        return None
    S = light[black].mean(axis=0)
    rho = light[white].mean(axis=0) - S
    lit = (rho > CONTRAST * np.median(rho)).all(axis=1)
    share = (light[:, lit] - S[lit]) / rho[lit]
    weight = whole[:, lit].all(axis=2) * rho[lit].min(axis=1)
    total = np.einsum("fn,fnc->fc", weight, share, dtype=np.float64)
    seen = np.flatnonzero(shown & (total > CONTRAST * np.median(total[shown], axis=0)).all(axis=1))
    if seen.size < FEWEST:
        return None
    gains = np.log(total[seen] / total[seen, 1:2])
    if known is not None:
        gains += np.log(known[seen])
    path = median_filter(gains, (NEAR, 1), mode="nearest")
    apart = MEDIAN_TO_SIGMA * float(np.median(np.abs(gains - path)[:, ::2]))
    if known is None and float(path.std(axis=0).max()) < max(LEAST, SURE * apart):
        return None
    frames = np.arange(len(patterns))
    logarithms = np.stack([np.interp(frames, seen, channel) for channel in (path - path[0]).T], axis=1)
    return np.asarray(np.exp(logarithms), np.float64)
