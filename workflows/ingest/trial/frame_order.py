"""Whether each frame shows the pattern that it is said to, by thumbnails, before anything is recovered."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from storage.layout.captures import Stack, thumbnail_edge, thumbnail_mask
from workflows.images.resample import area_mean
from workflows.ingest.camera.border_exposure import BorderValues
from workflows.ingest.camera.lit import light_of_thumbnails, rough_curve
from workflows.ingest.light.stack_attributes import exposures_of, program_of
from workflows.ingest.video.resemblance import GRIDS, MIN_PATTERNS, coarse_light
from workflows.programs.parts import Bernoulli
from workflows.programs.program import Program
from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA

PLACES = 400
"""Blocks of the frame that are compared, at most,"""
FEW = 80
"""and where many orders are tried."""
FEWEST = 30
"""Blocks that are needed."""
BRIGHTEST = 0.98
"""The quantile of blocks that tells how much the brightest see."""
CHANGES = 0.2
"""A block sees the monitor if its deviation is more than this share of the most changing blocks'."""
TYPICAL = 0.3
"""No frame is odd in a part whose frames typically resemble their patterns less than this."""
HARDLY, SURE = 0.3, 5.0
"""A frame is odd if it resembles its pattern less than this share of what is typical, and by so many of the part's
standard deviations less. Through frosted glass, single good ones reach only 0.42 of it."""
MOST_ODD = 0.1
"""A larger share of odd frames are not single accidents: they stay in, and other orders are tried."""
BEYOND, COVERED = 0.1, 0.1
"""A frame is odd, too, if more than `COVERED` of its blocks are outside of black and white by more than `BEYOND` of
their difference, and those of usual ones are not."""
SHIFTS = (-3, -2, -1, 1, 2, 3)
"""Shifts of later frames that are tried: stills that are missing, or that were taken twice."""
STARTS = 16
"""Frames from which on shifts are tried at first, spread over the program."""
MOST = 1000
"""Frames of captures of which other orders are tried."""
GAIN, CLEAR = 2.0, 2.0
"""By how much, in frames that look exactly like their patterns, another order must look more like the program than the
stated one; and how many times as much as random orders."""
NAMED = 0.4
"""How much frames must look like their patterns in an order that is named, on average: 1 is exactly."""
EVEN = 1e-3
"""Largest difference between the cells of a constant pattern, which is rounding."""
UNLIKE = 1.5
"""The stated order must look this many times as much like the program as random orders."""
ORDERS = 8
"""Random orders to compare with."""
APART, FAINT, WIDESPREAD = 0.1, 0.01, 0.05
"""Frames of one constant differ if more than `WIDESPREAD` of the blocks do, by more than `APART` of white, and by more
than `FAINT` of full scale: less is noise, where white is dark."""

Floats = NDArray[np.float32]
Integers = NDArray[np.intp]


class Order(NamedTuple):
    """How the order of the frames differs from the one that the capture states.

    Attributes
    ----------
    kind : str
        ``reversed``; ``rolled``: the first frame shows pattern ``by``, as where names are counted on from 9999 to 1;
        ``shifted``: from frame ``first`` on each shows the pattern ``by`` after its own; ``unlike``: no frame shows its
        pattern.
    """

    kind: Literal["reversed", "rolled", "shifted", "unlike"]
    first: int = 0
    by: int = 0

    def of(self, patterns: Integers) -> Integers:
        """The patterns that frames show in this order, given those that they are said to show."""
        if self.kind == "reversed":
            return patterns[::-1]
        if self.kind == "rolled":
            return np.roll(patterns, -self.by)
        later = np.arange(len(patterns)) >= self.first
        return np.clip(patterns + self.by * later, 0, len(patterns) - 1)


def check_frames(stack: Stack, border: BorderValues | None) -> None:
    """Find the frames that do not show their patterns, and annotate the stack with them.

    Blocks that see the border of a film, which differs from frame to frame, are left out.

    ``odd_frames`` are single ones of random patterns, as with a hand in the picture, a flash, or a still in the place
    of another: recovery does without them. ``order`` has the attributes of an `Order` if the frames are in another one.
    ``constants_apart`` has ``frames`` of one constant that differ, and the ``share`` of the blocks that do. Both are
    None otherwise.

    Notes
    -----
    A block of the frame sees one place of the monitor best: the cell, of several grids, whose light in all patterns
    correlates most with the block's. What blocks see of a frame is then correlated with what their cells have in each
    pattern. Neither exposure nor the light of the room makes a difference to this, and a single wrong frame not to the
    cells. A wrong order fits some cell by chance: orders are compared by how much like its own pattern each frame is.
    """
    stack.annotate(odd_frames=[], order=None, constants_apart=None)
    program = program_of(stack.attributes)
    light = _light_of(stack, border)
    if light is None:
        return
    stated = np.array(stack.attributes["patterns"])
    frames = np.flatnonzero(exposures_of(stack.attributes) == 1)
    seen, patterns = light[frames], stated[frames]
    ends = _ends(patterns, program)
    if ends is not None:
        apart, share = _constants_apart(seen, ends)
        if share > WIDESPREAD:
            stack.annotate(constants_apart={"frames": frames[apart].tolist(), "share": share})
    parts = _random_parts(patterns, program)
    if not parts:
        return
    cells = _cells(coarse_light(program, rough_curve(program.monitor.response), stack.images()))
    found = find_order(seen, patterns, cells, parts)
    if found is not None:
        stack.annotate(order=found._replace(first=int(frames[found.first]))._asdict())
        return
    odd = find_odd(seen, patterns, cells, parts)
    if ends is not None:
        odd = np.union1d(odd, _beyond(seen, ends, parts))
    if odd.size <= MOST_ODD * sum(map(len, parts)):
        # Longer exposures, which clip, are not compared: those of a pattern were taken together.
        lost = np.setdiff1d(patterns[odd], np.delete(patterns, odd))
        stack.annotate(odd_frames=np.union1d(frames[odd], np.flatnonzero(np.isin(stated, lost))).tolist())


def find_odd(seen: Floats, patterns: Integers, cells: Floats, parts: Sequence[Integers]) -> Integers:
    """The frames that look unlike their patterns, where others of their part do not.

    Parameters
    ----------
    seen : (frames, n) float32
        The light of blocks.
    patterns : (frames,) intp
        The pattern of each frame.
    cells : (patterns, cells) float32
        The light of the monitor.
    parts : sequence of intp
        The frames of each part to compare.
    """
    alike = _alikeness(seen, patterns, cells, np.concatenate(parts))
    odd: list[Integers] = []
    at = 0
    for frames in parts:
        own = alike[at : at + len(frames)]
        at += len(frames)
        typical = float(np.median(own))
        usual = MEDIAN_TO_SIGMA * float(np.median(np.abs(own - typical)))
        below = (own < HARDLY * typical) & (own < typical - SURE * usual)
        odd.append(frames[below] if typical >= TYPICAL else frames[:0])
    return np.concatenate(odd)


def find_order(seen: Floats, patterns: Integers, cells: Floats, parts: Sequence[Integers]) -> Order | None:
    """The order that the frames are in, None if it is that of the patterns; parameters as of `find_odd`."""
    compared = np.concatenate(parts)
    rng = np.random.Generator(np.random.PCG64(0))
    chance = float(np.mean([_score(seen, rng.permutation(patterns), cells, compared) for _ in range(ORDERS)]))
    own = _score(seen, patterns, cells, compared)
    # Only frames that stand for the patterns one by one can be in another order.
    if len(patterns) <= MOST and np.array_equal(patterns, np.arange(len(patterns))):
        few, coarse = seen[:, :: -(-seen.shape[1] // FEW)], cells[:, : _count(GRIDS[:-1])]

        def likeness(order: Order) -> float:
            return _score(few, order.of(patterns), coarse, compared)

        def closely(order: Order) -> float:
            return _score(seen, order.of(patterns), cells, compared)

        step = -(-len(compared) // STARTS)
        tried = [Order("shifted", n, by) for n in compared[::step].tolist() for by in SHIFTS]
        if own < CLEAR * chance:
            tried += [Order("rolled", by=by) for by in range(1, len(patterns))] + [Order("reversed")]
        found = max(tried, key=likeness)
        if found.kind == "shifted" and likeness(found) > _score(few, patterns, coarse, compared):
            near = range(max(found.first - step, 0), min(found.first + step, len(patterns)))
            found = max((found._replace(first=n) for n in near), key=closely)
        best = closely(found)
        if best > max(own + GAIN, CLEAR * chance, NAMED * len(compared)):
            return found
    return Order("unlike") if own < UNLIKE * chance else None


def _score(seen: Floats, patterns: Integers, cells: Floats, compared: Integers) -> float:
    """How much the frames compared look like their patterns: the sum of `_alikeness`."""
    # Constants look the same in all cells, and would drown what frosted glass shows of the others.
    uneven = np.ptp(cells[patterns], axis=1) > EVEN
    kept = np.cumsum(uneven) - 1
    compared = kept[compared[uneven[compared]]]
    return float(_alikeness(seen[uneven], patterns[uneven], cells, compared).sum())


def _alikeness(seen: Floats, patterns: Integers, cells: Floats, compared: Integers) -> Floats:
    """Correlations, (k,), of what blocks see of the k frames compared with what their cells have in their patterns."""
    of_frames = cells[patterns]
    cell = np.argmax(_unit(seen, 0).T @ _unit(of_frames, 0), axis=1)
    of_cell = of_frames[:, cell]
    centre, scale = np.median(seen, axis=0), np.maximum(seen.std(axis=0), 1e-9)
    shown = (of_cell[compared] - of_cell.mean(axis=0)) / np.maximum(of_cell.std(axis=0), 1e-9)
    alike: Floats = (_unit((seen[compared] - centre) / scale, 1) * _unit(shown, 1)).sum(axis=1)
    return alike


def _unit(values: Floats, axis: int) -> Floats:
    """Values less their mean along an axis, of length 1."""
    values = values - values.mean(axis=axis, keepdims=True)
    unit: Floats = values / np.maximum(np.linalg.norm(values, axis=axis, keepdims=True), 1e-9)
    return unit


def _ends(patterns: Integers, program: Program) -> tuple[Integers, Integers] | None:
    """The frames of the darkest and of the brightest constants; None if there are none of either."""
    dark, bright = (np.flatnonzero(np.isin(patterns, end)) for end in program.ends())
    return (dark, bright) if len(dark) and len(bright) else None


def _beyond(seen: Floats, ends: tuple[Integers, Integers], parts: Sequence[Integers]) -> Integers:
    """The frames of random patterns that are brighter than white or darker than black where usual ones are not."""
    dark, bright = (np.median(seen[frames], axis=0) for frames in ends)
    frames = np.concatenate(parts)
    room = BEYOND * np.maximum(bright - dark, 0)
    beyond = ((seen[frames] > bright + room) | (seen[frames] < dark - room)).mean(axis=1)
    odd: Integers = frames[beyond > COVERED + np.median(beyond)]
    return odd


def _constants_apart(seen: Floats, ends: tuple[Integers, Integers]) -> tuple[Integers, float]:
    """The frames of black or of white, whichever differ more from each other, and the share of blocks that do."""
    white = float(np.quantile(np.median(seen[ends[1]], axis=0), BRIGHTEST))
    shares = [float((np.ptp(seen[frames], axis=0) > max(APART * white, FAINT)).mean()) for frames in ends]
    return ends[int(np.argmax(shares))], max(shares)


def _light_of(stack: Stack, border: BorderValues | None) -> Floats | None:
    """The approximate light of blocks that are to be recovered and see the patterns, (frames, n)."""
    thumbnails = stack.thumbnails()
    if thumbnails is None:
        return None
    wanted = thumbnail_mask(stack.mask())
    if border is not None:
        of_border = np.zeros_like(wanted)
        of_border[tuple(border.places // thumbnail_edge(stack.height, stack.width))] = True
        wanted &= ~binary_dilation(of_border, np.ones((3, 3), bool))  # those beside see a part of it
    codes = thumbnails[:, wanted]
    light = light_of_thumbnails(codes, stack.attributes["response"])
    changes = light.std(axis=0)
    light = light[:, changes > CHANGES * np.quantile(changes, BRIGHTEST)]
    if light.shape[1] < FEWEST:
        return None
    chosen = np.unique(np.linspace(0, light.shape[1] - 1, PLACES).astype(int))
    return light[:, chosen]


def _random_parts(patterns: Integers, program: Program) -> list[Integers]:
    """The frames of each random part, if there are enough of them."""
    found = []
    for part, (start, end) in zip(program.parts, pairwise(program.starts), strict=True):
        frames = np.flatnonzero((patterns >= start) & (patterns < end))
        if isinstance(part, Bernoulli) and len(frames) >= MIN_PATTERNS:
            found.append(frames)
    return found


def _cells(light: Floats) -> Floats:
    """The light of every pattern in the cells of all `GRIDS`, (patterns, cells)."""
    grey = light.mean(axis=3, keepdims=True)
    return np.concatenate(
        [np.stack([area_mean(one, *grid).ravel() for one in grey]) for grid in GRIDS], axis=1
    )


def _count(grids: Sequence[tuple[int, int]]) -> int:
    return sum(columns * rows for columns, rows in grids)
