"""How the exposure of a film changed from pattern to pattern, by the border, whose light is known."""

from collections.abc import Sequence
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack, Strips
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import light_of_codes
from workflows.ingest.light.local_gain import Surroundings
from workflows.ingest.light.stack_attributes import program_of
from workflows.programs.border import border_light
from workflows.programs.program import Program

STRIPS, WIDE = 64, 4
"""Strips of the frame that are searched for the border, and how many columns each is wide,"""
ROWS = 512
"""and the rows of them that are looked at, at most, spread over the frame."""
AT_ONCE = 8
"""Strips that are looked at at a time."""
ROUNDS = 8
"""Rounds of fitting the light of the border and the exposures, one given the other: without veils, then with them."""
FOLLOWS = (0.5, 0.7)
"""A value sees the border if the bits explain this share of its variance: of codes and in the first rounds, then."""
VARIES = 0.01
"""It must vary by this share of what the 99th percentile of all values varies by."""
MIN_VALUES = 40
"""Values that see the border, at least."""
MOST_VALUES = 2048
"""At most so many values are looked at, of those that may see the border."""
SHOULDER = 0.93
"""Codes from here on are left out: cameras compress what is nearly white."""
LEAST = 0.01
"""Light below which a value says nothing."""
LEAST_SPREAD = 100.0
"""How much the light of a frame's usable values must differ, as a sum of weighted squares: with less, its exposure has
a standard error of over 10 %, and is taken for the usual one."""
LEAST_SWING = 0.03
"""The standard deviation that they must have, as a share of that of the border's light. Of a recording of the screen
itself, in which black and white clip, some codes beside black are left."""
TRIFLE = 0.003
"""A standard deviation of the exposures below this is none."""
MOST_APART = 1.3
"""Ratio of the exposures of the constant frames from which on they tell no curve: the camera was not locked."""

Doubles = NDArray[np.float64]
Scalar = TypeVar("Scalar", np.float32, np.float64)


class BorderLight(NamedTuple):
    """What the n values that see the border of a film show, in the order of the frames.

    Attributes
    ----------
    exposure : (frames,) float64
        Their median is 1.
    own : (frames, n) float64
        The border's own light.
    rest : (frames, n) float64
        The light, by the exposure, that neither the border nor the veil of the frame explains; 0 if not usable.
    usable : (frames, n) bool
    design : (frames, k) float64
        What each value's own light is a sum of, in unknown amounts.
    places : (2, n) intp
        Row and column of each value.
    """

    exposure: Doubles
    own: Doubles
    rest: Doubles
    usable: NDArray[np.bool_]
    design: Doubles
    places: NDArray[np.intp]


def strips_of(height: int, width: int) -> Strips:
    """The pixels of a frame among which the border is searched for."""
    left = np.arange(STRIPS) * width // STRIPS
    columns = np.unique(np.minimum(np.add.outer(left, np.arange(WIDE)), width - 1))
    return Strips(np.arange(0, height, -(-height // ROWS)), columns, AT_ONCE * WIDE)


class BorderValues:
    """Values that may see the border of a film, in all frames.

    Parameters
    ----------
    stack : Stack
    program : Program
    """

    @classmethod
    def of(cls, stack: Stack) -> Self | None:
        """The values of a stack; None if it is not a film with a border."""
        if not stack.attributes.get("border"):
            return None
        return cls(stack, program_of(stack.attributes))

    def __init__(self, stack: Stack, program: Program) -> None:
        strips = strips_of(stack.height, stack.width)
        bits = border_light(range(program.count))[:, stack.attributes["patterns"]]
        self.design = np.concatenate([np.ones((1, stack.frames)), bits]).T
        firsts = range(0, strips.columns.size, strips.wide)
        found = [self._follow(stack, strips, slice(first, first + strips.wide)) for first in firsts]
        codes, places, whole = (np.concatenate(each, axis=1) for each in zip(*found, strict=True))
        # What hardly varies, as a dark room that compression makes quite black, follows anything.
        kept = np.flatnonzero(whole[0] > VARIES * whole.max(initial=0))
        kept = kept[:: max(-(-kept.size // MOST_VALUES), 1)]
        self.codes, self.places = codes[:, kept], places[:, kept]
        top = np.iinfo(stack.dtype).max
        self.usable = np.asarray(((self.codes > 0) & (self.codes < SHOULDER * top)).all(axis=2))

    def _follow(
        self, stack: Stack, strips: Strips, part: slice
    ) -> tuple[Codes, NDArray[np.intp], NDArray[np.float32]]:
        """The values of some strips that vary as the bits do: (frames, n, channels), their places (2, n), and their
        variances (1, n).
        """
        rows, columns = strips.rows, strips.columns[part]
        codes = stack.read_strips(part)
        if codes is None:
            codes = stack.read_some(rows, columns)  # from chunks all over the frames
        codes = codes.reshape(stack.frames, -1, stack.channels)
        grey, design = codes.mean(axis=2, dtype=np.float32), self.design.astype(np.float32)
        whole, _, unexplained = _spread(grey, design @ (np.linalg.pinv(design) @ grey), design.shape[1])
        kept = np.flatnonzero((unexplained < 1 - FOLLOWS[0]) & (whole > 0))
        places = np.stack(np.meshgrid(rows, columns, indexing="ij")).reshape(2, -1)
        return codes[:, kept], places[:, kept], whole[np.newaxis, kept]

    def exposures(
        self,
        look_up: NDArray[np.float32],
        local: Surroundings | None = None,
        balance: Doubles | None = None,
    ) -> Doubles | None:
        """The exposure of each frame, as of `fit`."""
        found = self.fit(look_up, local, balance)
        return None if found is None else found.exposure

    def fit(
        self,
        look_up: NDArray[np.float32],
        local: Surroundings | None = None,
        balance: Doubles | None = None,
    ) -> BorderLight | None:
        """The exposure of each frame and the border's light; None if too few values see the border.

        Parameters
        ----------
        look_up : (k,) or (k, channels) float32
            The light of each code.
        local : Surroundings, optional
            The local gain of tone mapping, as from `workflows.ingest.light.local_gain.local_gain`.
        balance : (frames, 3) float64, optional
            As from `workflows.ingest.light.stack_attributes.white_balance_of`.

        Notes
        -----
        What a value sees of the border is linear in the bits of the pattern's number. Onto it comes the veil d of the
        frame, light of the patterns that lens and room spread, and all is times the exposure g of the frame:
        ``v = g (a_0 + sum_b a_b B_b + d)``. The amounts a are fitted to ``v / g - d``, and then g and d, by a straight
        line in each frame, to the light that they predict. Without d, a frame with a bright pattern would seem to be
        exposed longer. Values that are clipped, or nearly, are filled in by what is predicted.
        """
        if self.codes.shape[1] < MIN_VALUES:
            return None
        coloured = light_of_codes(self.codes, look_up)
        if balance is not None:
            coloured /= balance[:, np.newaxis].astype(np.float32)
        light = coloured.mean(axis=2, dtype=np.float64)
        if local is not None:
            light /= local.at(*self.places)
        frames, terms = self.design.shape
        inverse = np.linalg.pinv(self.design)
        exposure, veil = np.ones((frames, 1)), np.zeros((frames, 1))
        predicted = self.design @ (inverse @ light)
        for turn in range(2 * ROUNDS):
            even = np.where(self.usable, light / exposure - veil, predicted)
            predicted = self.design @ (inverse @ even)
            whole, rest, unexplained = _spread(even, predicted, terms)
            varies = whole > VARIES * np.quantile(whole, 0.99)
            follows = unexplained < 1 - (FOLLOWS[0] if turn <= ROUNDS // 3 else FOLLOWS[1])
            border = np.flatnonzero(follows & varies & (predicted.min(axis=0) > -LEAST))
            if border.size < MIN_VALUES:
                return None
            exposure, veil = _lines(
                predicted[:, border],
                light[:, border],
                self.usable[:, border] / np.maximum(rest[border], np.median(rest[border])),
                turn >= ROUNDS,
            )
            veil -= self.design @ (inverse @ veil)  # that part is the border's own light
        usable = self.usable[:, border]
        even = np.where(usable, light[:, border] / exposure - veil, predicted[:, border])
        own = self.design @ (inverse @ even)
        rest = np.where(usable, even - own, 0)
        return BorderLight(exposure[:, 0], own, rest, usable, self.design, self.places[:, border])


def _spread(
    values: NDArray[Scalar], predicted: NDArray[Scalar], terms: int
) -> tuple[NDArray[Scalar], NDArray[Scalar], NDArray[Scalar]]:
    """Of values in all frames: their variance, that of what a sum of so many terms leaves, and its share of the former.

    Each is (n,). The share is unbiased: about 1 for values that have nothing to do with the terms.
    """
    frames = len(values)
    whole, rest = np.var(values, axis=0), np.var(values - predicted, axis=0)
    return whole, rest, rest / np.maximum(whole, 1e-12) * (frames - 1) / (frames - terms)


def _lines(predicted: Doubles, light: Doubles, weight: Doubles, veiled: bool) -> tuple[Doubles, Doubles]:
    """The exposure and the veil of each frame, (frames, 1): ``light = exposure (predicted + veil)``, by least squares.

    A frame whose usable values are too few, or too much alike, has an exposure of 1 and no veil; no frame has one
    unless they are ``veiled``.
    """
    x = y = np.zeros((len(light), 1))
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    if veiled:
        x, y = ((weight * v).sum(axis=1, keepdims=True) / total for v in (predicted, light))
    off = predicted - x
    spread = (weight * off**2).sum(axis=1, keepdims=True)
    slope = (weight * off * (light - y)).sum(axis=1, keepdims=True) / np.maximum(spread, 1e-12)
    known = spread >= np.maximum(LEAST_SPREAD, (LEAST_SWING * predicted.std()) ** 2 * total)
    exposure = np.where(known, slope, 1)
    exposure = np.maximum(exposure / np.median(exposure), 1e-3)
    return exposure, np.where(veiled & known, y / exposure - x, 0)


def shortest_white(exposures: Doubles, patterns: Sequence[int], program: Program) -> int | None:
    """The frame of a white monitor that was exposed the shortest, and so clips least; None if there is none."""
    numbers, sent = program.constants
    white = np.flatnonzero(np.isin(patterns, numbers[(sent == 1).all(axis=1)]))
    return int(white[np.argmin(exposures[white])]) if white.size else None


def relative_to_white(exposures: Doubles, patterns: Sequence[int], program: Program) -> Doubles:
    """Exposures in units of the shortest of a white monitor; unchanged if no frame shows one.

    For a camera that was not locked, whose usual exposure is that of patterns, which are darker: composites with
    bright backdrops would exceed full scale.

    Parameters
    ----------
    exposures : (frames,) float64
    patterns : (frames,) sequence of int
        What each frame shows.
    program : Program
    """
    white = shortest_white(exposures, patterns, program)
    return exposures if white is None else exposures / exposures[white]


def is_free(exposed: Sequence[float] | NDArray[np.float64] | None) -> bool:
    """Whether the exposure of a film, or of stills, was not locked.

    Then errors of the exposures make more values brighter than white than noise does.
    """
    return exposed is not None and bool(np.max(exposed) > MOST_APART * np.min(exposed))
