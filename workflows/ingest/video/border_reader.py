"""Find the display in a recording, and the frames of each pattern by the numbers in its border."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, find_objects, label

from workflows.ingest.video.missing_patterns import Reason
from workflows.ingest.video.recording import Recording
from workflows.ingest.video.signatures import LargeFrames
from workflows.ingest.video.timing import FoundPatterns
from workflows.programs.border import LEAD, TICKS, Border, Box, read_numbers
from workflows.recovery.camera.homography import fit_homography

LOOKS = 6
"""Large frames to take while a pattern is shown."""
MIN_PLATEAUS = 8
"""Plateaus that are needed to tell the border's cells from patterns."""
BATCH = 128
"""Plateaus that the display is located by, and whose numbers are read at a time."""
_PLATEAUS = 2  # for each pattern, at most
# Light of each code. The curve only has to be close enough to any camera's to compare the cells of a pair.
_LIGHT = ((np.arange(256) / 255) ** 2.2).astype(np.float32)
_ALIKE = 0.98  # least correlation of two plateaus that show the same, by another exposure
_ALTERNATES = 0.6  # least `_alternation` of the sides
_CONTRAST = 0.15  # least contrast of a pixel of the sides, as a share of the frame's largest
_WITHIN = (0.3, 0.5, 0.7)  # where a cell is sampled, along each axis
_SIMPLEX = 1.0  # pixels: the first step of the search for the corners
_IN_ORDER = 0.5  # of the plateaus with numbers, this share must be in order
_BEYOND = 3  # numbers that a program does not have, from which on another one was shown

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
"""(plateaus, rows, columns) float32: what the camera saw, in approximately linear light."""
Points = NDArray[np.float64]
"""(n, 2) float64: x, y in pixels."""


def find_by_numbers(
    recording: Recording, large: LargeFrames, border: Border, patterns: int
) -> FoundPatterns | None:
    """Find the frames of each pattern by the numbers in the border.

    Parameters
    ----------
    recording : Recording
    large : LargeFrames
    border : Border
        As it was shown.
    patterns : int
        Number of patterns in the program.

    Returns
    -------
    FoundPatterns or None
        None if the border can't be read: it is out of the picture, too small, or another one.

    Notes
    -----
    An exposure that settles while a pattern is shown divides its plateau: of those that look alike, one is taken. The
    cells of the sides alternate from each pattern to the next: pixels that do so form two columns, whose ends are four
    points of the display. Starting from these, the simplex method of Nelder and Mead (1965) searches for the homography
    with the largest differences within all pairs of cells. Numbers must ascend in time; what is not in the longest
    ascending sequence is a misreading.
    """
    plateaus = [recording.plateau(n) for n in range(len(recording.events) + 1)]
    if len(plateaus) > _PLATEAUS * patterns + 100:
        return None
    # The first and the last frame of a plateau may be torn.
    inner = [_among(large, plateau[1:-1]) for plateau in plateaus]
    chosen = [looks if looks.size else _among(large, p) for looks, p in zip(inner, plateaus, strict=True)]
    there = np.flatnonzero([looks.size > 0 for looks in chosen])
    whole = np.flatnonzero([inner[n].size > 0 for n in there])
    if whole.size < MIN_PLATEAUS:
        return None
    codes = np.stack([np.median(large.grey[chosen[n]], axis=0).astype(np.uint8) for n in there])
    whole = whole[_differ(_LIGHT[codes[whole]])]
    if whole.size < MIN_PLATEAUS:
        return None
    middle = max((whole.size - BATCH) // 2, 0)
    some = codes[whole[middle : middle + BATCH]]
    for quarters in range(4):
        light = _LIGHT[np.rot90(some, quarters, axes=(1, 2))]
        ends = _columns(light)
        if ends is None:
            continue
        homography = _adjusted(light, ends, border)
        upright = np.rot90(codes, quarters, axes=(1, 2))
        parts = (_LIGHT[upright[at : at + BATCH]] for at in range(0, len(upright), BATCH))
        numbers = np.concatenate([_numbers(part, homography, border) for part in parts])
        longer = _longer(numbers, patterns)
        numbers[numbers >= patterns] = LEAD
        row = _ascending(numbers)
        if len(row) >= max(MIN_PLATEAUS, _IN_ORDER * np.count_nonzero(numbers > LEAD)):
            found = _found(recording, {int(there[at]): int(numbers[at]) for at in row}, patterns)
            return replace(found, longer=longer)
    return None


def _differ(light: Floats) -> NDArray[np.intp]:
    """The plateaus that differ from the one before, by more than a factor."""
    flat = light.reshape(len(light), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    size = np.maximum(np.linalg.norm(flat, axis=1), 1e-6)
    alike = np.einsum("ij,ij->i", flat[1:], flat[:-1]) / (size[1:] * size[:-1])
    return np.flatnonzero(np.concatenate([[True], alike < _ALIKE]))


def _among(large: LargeFrames, frames: range) -> NDArray[np.intp]:
    """The large frames, by their index among these, that lie within a range of frames."""
    return np.flatnonzero((large.frames >= frames.start) & (large.frames < frames.stop))


def _columns(light: Floats) -> Points | None:
    """The ends of the middle lines of both sides: left top, left bottom, right top, right bottom."""
    column: list[list[tuple[float, float]]] = []
    mask = binary_dilation(_alternation(light) > _ALTERNATES, np.ones((5, 1), bool))
    labels, _ = label(mask, np.ones((3, 3)))
    boxes = [(place, n + 1) for n, place in enumerate(find_objects(labels))]
    boxes.sort(key=lambda found: found[0][0].start - found[0][0].stop)
    for (rows, _), number in boxes[:2]:
        of_row = [np.flatnonzero(labels[y] == number) for y in range(rows.start, rows.stop)]
        # without the rows that the dilation added
        y = np.arange(rows.start, rows.stop)[2:-2]
        x = np.array([xs.mean() for xs in of_row])[2:-2]
        width = float(np.median([xs.size for xs in of_row]))
        if y.size < 2 * TICKS:
            return None
        kept = np.ones(x.size, bool)
        for _ in range(4):  # the cells of the parity lie beside the end of a column
            slope, start = np.polyfit(y[kept], x[kept], 1)
            off = np.abs(x - slope * y - start)
            kept = off <= max(2 * float(np.median(off)), 0.35 * width)
        top, bottom = y[kept].min() - 0.5, y[kept].max() + 0.5
        column.append([(slope * end + start, end) for end in (top, bottom)])
    if len(column) < 2:
        return None
    return np.array(sorted(column)).reshape(4, 2)


def _alternation(light: Floats) -> Floats:
    """How strictly a pixel alternates between plateaus, (rows, columns) float32.

    It is 1 where each plateau differs from the next but not from the one after that, and about 0 for random changes.
    Changes that do not happen are not counted.
    """
    contrast = np.quantile(light, 0.9, axis=0) - np.quantile(light, 0.1, axis=0)
    near = np.abs(light[1:] - light[:-1]).mean(axis=0)
    far = np.abs(light[2:] - light[:-2]).mean(axis=0)
    seen = contrast > _CONTRAST * contrast.max()
    return np.where(seen, (near - far) / np.maximum(near + far, 1e-6), 0)


def _adjusted(light: Floats, ends: Points, border: Border) -> Doubles:
    """The homography from the display to the frame, (3, 3), that makes the cells of each pair differ most."""
    first, last = border.left[0], border.left[-1]
    top, bottom = first[1], last[1] + last[3]
    left, right = border.thickness / 2, border.width - border.thickness / 2
    x, y = np.array([(left, top), (left, bottom), (right, top), (right, bottom)]).T
    cells = (*border.top, *border.bottom, *border.left, *border.right)
    # A pixel of all plateaus lies together: it is looked up hundreds of times.
    light = np.ascontiguousarray(light.transpose(1, 2, 0))

    def alike(moved: Doubles) -> float:
        pairs = _cells(light, fit_homography(x, y, ends + moved.reshape(4, 2)), cells)
        return -float(np.abs(pairs[::2] - pairs[1::2]).mean())

    simplex = np.concatenate([np.zeros((1, 8)), _SIMPLEX * np.eye(8)])
    from scipy.optimize import minimize  # takes half a second to import, and only videos need it

    best = minimize(
        alike,
        np.zeros(8),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "maxfev": 600},
    )
    return fit_homography(x, y, ends + best.x.reshape(4, 2))


def _cells(light: Floats, homography: Doubles, cells: Sequence[Box]) -> Doubles:
    """Mean light of the inner half of each cell, (cells, plateaus), interpolated linearly; 0 outside of the frame.

    Unlike elsewhere, light is (rows, columns, plateaus).
    """
    box = np.array(cells, float)
    x = box[:, 0, None, None] + box[:, 2, None, None] * np.array(_WITHIN)[:, None]
    y = box[:, 1, None, None] + box[:, 3, None, None] * np.array(_WITHIN)[None, :]
    x, y = np.broadcast_arrays(x, y)
    across, down, scale = np.tensordot(homography, np.stack([x, y, np.ones_like(x)]), 1)
    # The value of a pixel belongs to its centre.
    u, v = across / scale - 0.5, down / scale - 0.5
    height, width = light.shape[:2]
    inside = (u > -1) & (v > -1) & (u < width) & (v < height) & (scale > 0)
    u, v = np.clip(np.where(inside, u, 0), 0, width - 1), np.clip(np.where(inside, v, 0), 0, height - 1)
    i, j = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
    a, b = (u - i)[..., np.newaxis], (v - j)[..., np.newaxis]
    values = (light[j, i] * (1 - a) + light[j, i + 1] * a) * (1 - b)
    values += (light[j + 1, i] * (1 - a) + light[j + 1, i + 1] * a) * b
    return np.asarray((values * inside[..., np.newaxis]).mean(axis=(1, 2)))


def _numbers(light: Floats, homography: Doubles, border: Border) -> NDArray[np.intp]:
    """The number that each plateau shows, (plateaus,); `LEAD` if there is none, or none that is certain."""
    light = light.transpose(1, 2, 0)
    read = [read_numbers(_cells(light, homography, cells).T) for cells in (border.top, border.bottom)]
    (above, clear_above), (below, clear_below) = read
    number = np.where(clear_above, above, below)
    ticks = _cells(light, homography, (*border.left, *border.right))
    odd = ticks[::2].sum(axis=0) > ticks[1::2].sum(axis=0)
    certain = (clear_above | clear_below) & ~(clear_above & clear_below & (above != below))
    return np.where(certain & (odd == (number + 1) % 2), number, LEAD)


def _ascending(numbers: NDArray[np.intp]) -> list[int]:
    """Indices of the longest sequence of numbers that never falls, by patience sorting (Fredman, 1975)."""
    ends: list[int] = []
    before: dict[int, int | None] = {}
    for at in np.flatnonzero(numbers > LEAD).tolist():
        place = int(np.searchsorted([numbers[end] for end in ends], numbers[at], "right"))
        before[at] = ends[place - 1] if place else None
        ends[place : place + 1] = [at]
    row: list[int] = []
    last = ends[-1] if ends else None
    while last is not None:
        row.append(last)
        last = before[last]
    return row[::-1]


def _longer(numbers: NDArray[np.intp], patterns: int) -> int:
    """How many patterns are numbered at least, if these are more than there should be, and not a few misreadings."""
    seen = np.unique(numbers[_ascending(numbers)])
    beyond = seen[seen >= patterns]
    count = int(beyond.max(initial=0)) + 1
    return count if beyond.size >= max(_BEYOND, (count - patterns) / 2) else 0


def _found(recording: Recording, seen: dict[int, int], patterns: int) -> FoundPatterns:
    """The frames of each number from the plateaus that show it; from the longest, if several do."""
    frames = [np.zeros(0, np.intp)] * patterns
    weights = [np.zeros(0)] * patterns
    reasons: dict[int, Reason] = {}
    longest: dict[int, range] = {}
    for plateau, number in seen.items():
        if len(recording.plateau(plateau)) > len(longest.get(number, ())):
            longest[number] = recording.plateau(plateau)
    for number in range(patterns):
        if number in longest and len(longest[number]) > 1:
            frames[number], weights[number] = recording.clean(longest[number])
        elif number in longest:
            reasons[number] = Reason.TORN
        elif number < min(longest):
            reasons[number] = Reason.BEFORE
        elif number > max(longest):
            reasons[number] = Reason.AFTER
        else:
            reasons[number] = Reason.UNNUMBERED
    begins = np.array([recording.times[longest[number].start] for number in sorted(longest)])
    holds = np.diff(begins) / np.diff(sorted(longest))
    # The mean of the middle half leaves out what was cut or stood still.
    hold = float(np.sort(holds)[len(holds) // 4 : len(holds) - len(holds) // 4].mean())
    return FoundPatterns(
        frames,
        weights,
        reasons,
        float(begins[0] - recording.times[0]) - min(longest) * hold,
        1 / hold,
        0.0,
        False,
    )
