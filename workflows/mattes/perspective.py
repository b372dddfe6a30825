"""Where on the monitor a camera's pixels look beside the object: the perspective that bare pixels share."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, label

from storage.layout.mattes import Matte
from workflows.interruption import checkpoint
from workflows.mattes.lobes import block_lobes
from workflows.recovery.camera.homography import fit_homography
from workflows.threads import in_parts

LOBES = 3
"""Lobes of a pixel that are fitted; the heaviest is used."""
DIRECT = 0.75
"""A pixel may see the monitor directly if its heaviest lobe has at least this share of its light: the rest may be
glare, or mirrored by a table."""
NEAR = 0.004
"""How far such a pixel may deviate from the common perspective, in widths of the monitor."""
ROUGHLY = 0.012
"""The same, where patterns without a fine grid tell places less well."""
RIM = 0.05
"""Width of the rim in which bare pixels are looked for, as a share of the frame's larger side."""
LEAST_RIM = 0.3
"""Share of the rim's pixels that must agree."""
LEAST_PART = 0.02
"""Groups of pixels that are smaller than this share of the largest are no part of the rim."""
MOST_RIM = 4000
"""Pixels of the rim that are tried, about."""
LEAST = 16
"""Pixels that must agree at least."""
TRIALS = 300
"""Perspectives that are tried, each through four pixels."""
LEAST_DEPTH = 0.2
"""How far a corner of the frame is from the camera at least, along its axis, in distances of the farthest."""
FARTHEST = 20
"""How far beyond the monitor the frame reaches at most, in its widths and heights."""
ROUNDS = 10
"""Most times that the pixels which agree with a fit are chosen again."""
Places = NDArray[np.float32]
"""(height, width, 4) float32: the heaviest lobe of every pixel, see `places_of`."""
Bools = NDArray[np.bool_]
Doubles = NDArray[np.float64]


def places_of(matte: Matte, threads: int) -> Places:
    """The heaviest lobe of every pixel.

    Returns
    -------
    (height, width, 4) float32
        Its centre, in widths and heights of the monitor from the top left; its mean standard deviation, in widths; and
        its share of the light, which is 0 where nothing was recovered.
    """
    places = np.zeros((matte.height, matte.width, 4), np.float32)
    blocks = list(product(range(matte.block_rows), range(matte.block_columns)))

    def one(number: int) -> None:
        lobe = block_lobes(matte, matte.read(*blocks[number]), LOBES)[:, :, 0]
        at = places[matte.span(*blocks[number])]
        at[..., 3] = lobe[..., 2:5].mean(axis=2)
        at[..., 0], at[..., 1] = lobe[..., 0], np.where(at[..., 3] > 0, 1 - lobe[..., 1], 0)
        at[..., 2] = np.sqrt(lobe[..., 5] * lobe[..., 6])

    in_parts(one, range(len(blocks)), threads)
    return places


@dataclass(frozen=True)
class Sight:
    """Where on the monitor the pixels of a frame look beside the object, through a lens that bends straight lines.

    Attributes
    ----------
    height, width : int
        Of the frame.
    perspective : (3, 3) float64
        See `sights`.
    bend : (10, 2) float64
        What the lens adds, in widths and heights of the monitor: a polynomial of the third degree.
    """

    height: int
    width: int
    perspective: Doubles
    bend: Doubles

    @property
    def straight(self) -> Doubles:
        """Without the bend, a homography (3, 3) from the frame, which is from 0 to 1 across and down."""
        found = self.perspective @ ((2, 0, -1), (0, 2, -1), (0, 0, 1))
        return np.asarray(found / found[2, 2])

    def at(self, y: Doubles, x: Doubles) -> Doubles:
        """The places that pixels with these rows and columns see, (..., 2), in widths and heights of the monitor."""
        across, down = in_frame(y, x, self.height, self.width)
        return sights(self.perspective, across, down) + _cubic(across, down) @ self.bend


def corners(straight: Doubles) -> Doubles:
    """Where on the monitor the corners of a frame look, (4, 2), by the homography of `Sight.straight`.

    Raises
    ------
    ValueError
        If the camera can't look so at the monitor: it is behind a corner, or far beyond it.
    """
    at = np.array([(x, y, 1.0) for y in (0, 1) for x in (0, 1)]) @ straight.T
    if not (np.isfinite(at).all() and at[:, 2].min() > LEAST_DEPTH * at[:, 2].max() > 0):
        raise ValueError("the frame does not face the monitor")
    seen = at[:, :2] / at[:, 2:]
    if np.abs(seen).max() > FARTHEST:
        raise ValueError("the monitor is too small in the frame")
    return np.asarray(seen)


def in_frame(y: Doubles, x: Doubles, height: int, width: int) -> tuple[Doubles, Doubles]:
    """How far across and down a frame pixels with some rows and columns are, from -1 to 1."""
    return (2 * x + 1) / width - 1, (2 * y + 1) / height - 1


def lengths(vectors: Doubles, aspect: float) -> Doubles:
    """The lengths of vectors (..., 2) in widths and heights of the monitor, in its widths."""
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1] * aspect))


def find_sight(places: Places, y: Doubles, x: Doubles, frame: tuple[int, int], aspect: float) -> Sight | None:
    """Where the pixels of a frame look, by what some of them see.

    Parameters
    ----------
    places : (h, w, 4) float32
        See `places_of`.
    y, x : (h, w) float64
        Their rows and columns in the frame.
    frame : (int, int)
        Height and width.
    aspect : float
        Height of the monitor as a share of its width.

    Returns
    -------
    Sight
        None if too few pixels see the monitor directly.
    """
    height, width = frame
    across, down = in_frame(y, x, height, width)
    perspective = find_perspective(places, across, down, aspect)
    if perspective is None:
        return None
    terms, left = _cubic(across, down), places[..., :2] - sights(perspective, across, down)
    sharp = places[..., 3] > DIRECT
    bend: Doubles = np.zeros((terms.shape[2], 2))
    fits = np.zeros_like(sharp)
    for _ in range(ROUNDS):
        before, fits = fits, sharp & (lengths(left - terms @ bend, aspect) < NEAR)
        if (fits == before).all():
            break
        bend = np.asarray(np.linalg.lstsq(terms[fits], left[fits], rcond=None)[0], np.float64)
    found = Sight(height, width, perspective, bend)
    try:
        corners(found.straight)
    except ValueError:
        return None
    return found


def _cubic(across: Doubles, down: Doubles) -> Doubles:
    """The terms of a polynomial of the third degree, (..., 10)."""
    return np.stack([across**i * down**j for i in range(4) for j in range(4 - i)], axis=-1)


def find_perspective(places: Places, across: Doubles, down: Doubles, aspect: float) -> Doubles | None:
    """The homography between pixels of a frame and the places on the monitor that they see beside the object.

    Parameters
    ----------
    places : (height, width, 4) float32
        See `places_of`.
    across, down : (height, width) float64
        Where the pixels are in the frame, from -1 to 1.
    aspect : float
        Height of the monitor as a share of its width.

    Returns
    -------
    (3, 3) float64
        See `sights`. None if too few pixels see the monitor directly.

    Notes
    -----
    Bare pixels lie along the rim of what shows the monitor, which is that of the frame or of the monitor itself. Of the
    homographies through four pixels of the rim (random sample consensus, Fischler and Bolles 1981) the one that most
    of them agree with is fitted to all pixels that do.
    """
    sharp = places[..., 3] > DIRECT
    if sharp.any():
        sharp &= places[..., 2] < 2 * np.median(places[..., 2][sharp])
    rim = np.flatnonzero(_rim(sharp))
    rim = rim[:: 1 + rim.size // MOST_RIM]
    if rim.size < LEAST:
        return None
    seen = places[..., :2].astype(np.float64)
    x, y, at = across.ravel()[rim], down.ravel()[rim], seen.reshape(-1, 2)[rim]
    tried = [fit_homography(x[four], y[four], at[four]) for four in _fours(rim.size)]
    off = np.stack([lengths(sights(one, x, y) - at, aspect) for one in tried])
    for near in (NEAR, ROUGHLY):
        agreed = np.count_nonzero(off < near, axis=1)
        if agreed.max() >= max(LEAST, LEAST_RIM * rim.size):
            break
    else:
        return None
    best = tried[np.argmax(agreed)]
    fits = np.zeros_like(sharp)
    for _ in range(ROUNDS):
        checkpoint()
        before, fits = fits, sharp & (lengths(sights(best, across, down) - seen, aspect) < near)
        if (fits == before).all():
            break
        best = fit_homography(across[fits], down[fits], seen[fits])
    return best


def _fours(count: int) -> Iterator[NDArray[np.intp]]:
    """Four of some pixels, again and again; the same each time."""
    random = np.random.default_rng(0)
    for _ in range(TRIALS):
        yield random.choice(count, 4, replace=False)


def sights(perspective: Doubles, across: Doubles, down: Doubles) -> Doubles:
    """Where on the monitor pixels look by a homography, (..., 2), in its widths and heights from the top left."""
    scale = perspective[2, 0] * across + perspective[2, 1] * down + perspective[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):  # of four pixels that determine none
        return np.stack(
            [
                (perspective[k, 0] * across + perspective[k, 1] * down + perspective[k, 2]) / scale
                for k in (0, 1)
            ],
            axis=-1,
        )


def between(there: Bools) -> Bools:
    """The pixels that are there, or between two of them in a row or a column."""
    found = np.zeros_like(there)
    for axis in (0, 1):
        before = np.logical_or.accumulate(there, axis)
        after = np.flip(np.logical_or.accumulate(np.flip(there, axis), axis), axis)
        found |= before & after
    return found


def _rim(sharp: Bools) -> Bools:
    """The outermost of some pixels, without small groups of them."""
    parts, _ = label(sharp)
    sizes = np.bincount(parts[sharp], minlength=1)
    large = sharp & (sizes >= LEAST_PART * np.max(sizes))[parts]
    width = max(1, round(RIM * max(sharp.shape)))
    return np.asarray(large & ~binary_erosion(between(large), iterations=width))
