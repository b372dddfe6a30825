"""The numbered border around the patterns, and the lead-in before them, by which a film is read reliably.

The patterns are shown in a rectangle, the monitor of their program, and the border lies around it, so recovery need not
know of it. Each bit is a pair of neighbouring cells, one lit and one dark; which of them is lit is the bit.

Notes
-----
Why pairs: a bit is the sign of a difference between neighbours. Exposure and vignetting scale both by the same
factor; a camera's curve is monotonic and keeps their order; blur keeps the sign as long as it is narrower than a cell.
Whatever the bits are, half of the cells are lit: the mean light of the border is constant, and becomes part of the
reflections S.

Why a Gray code: from one number to the next a single bit changes. A frame exposed across a change is undecided in that
bit and in the parity only, and reads as one of the two patterns that it saw, never as a third.

The number is shown along the top, and in reverse order along the bottom: a frame torn by a rolling shutter shows two
numbers, and an object that hides a bit above leaves it visible below. Along the left and the right a tick, the lowest
bit of the number + 1, is repeated from top to bottom: it shows in which rows a frame is torn.

References
----------
F. Gray, Pulse code communication, US patent 2,632,058, 1953.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from storage.errors import OptionError
from workflows.programs.parts import Record

BITS = 12
MAX_NUMBERED = 2**BITS - 1
"""Patterns that can be numbered: code 0 marks the lead-in and the lead-out."""
TICKS = 8
"""How often the tick is repeated along each side."""
LEAD = -1
"""The number of the lead-in and the lead-out."""
LEAD_SECONDS = (1.0, 0.5, 0.5, 0.5, 0.5)
"""Of black, white, black, white, black."""
MIN_CELL = 4
"""The least length of a cell in pixels."""
FAINT = 0.1
"""A median contrast of the pairs below this is noise: no display is in view."""
CERTAIN = 0.5
"""A bit is certain if its pair has at least this share of the median contrast."""

Box = tuple[int, int, int, int]
"""x, y, width, height in pixels."""


class Border(Record):
    """A display that showed the patterns inside a numbered border, in pixels, border included.

    The size of the display determines where the cells of the border are.
    """

    # The border is height // 20 pixels thick. Along the top and the bottom lie 2 (BITS + 1) cells, along each side
    # 2 TICKS: all as thick as the border, as long as whole pixels allow, and centred. The corners stay black.
    width: Annotated[int, Field(ge=1, le=16384, description="Width in pixels.", examples=[1920])]
    height: Annotated[int, Field(ge=1, le=16384, description="Height in pixels.", examples=[1080])]

    @model_validator(mode="after")
    def _room_for_cells(self) -> "Border":
        if min(self.top[0][2], self.left[0][3]) < MIN_CELL:
            raise ValueError(
                f"a display of {self.width} x {self.height} pixels is too small for the cells of a border"
            )
        return self

    @classmethod
    def around(cls, width: int, height: int) -> "Border":
        """The border around a rectangle of ``width`` x ``height`` pixels.

        Raises
        ------
        OptionError
            If the rectangle is too small for the cells around it, or too large for a display.
        """
        thickness = height // 18
        return cls.on(width + 2 * thickness, height + 2 * thickness)

    @classmethod
    def on(cls, width: int, height: int) -> "Border":
        """The border on a display of ``width`` x ``height`` pixels.

        Raises
        ------
        OptionError
            If the display is too small for the cells, or too large.
        """
        try:
            return cls(width=width, height=height)
        except ValidationError as error:
            raise OptionError(
                f"no border can be drawn on a display of {width} x {height} pixels: its cells need about 150 x 100, "
                "and 16384 x 16384 is the most",
                field="monitor",
            ) from error

    @property
    def thickness(self) -> int:
        """Thickness of the border in pixels."""
        return self.height // 20

    @property
    def inner(self) -> Box:
        """The rectangle that the patterns are shown in."""
        t = self.thickness
        return t, t, self.width - 2 * t, self.height - 2 * t

    @property
    def top(self) -> tuple[Box, ...]:
        """The cells along the top, in the order of `number_cells`."""
        return tuple((x, 0, size, self.thickness) for x, size in self._cells(self.width, BITS + 1))

    @property
    def bottom(self) -> tuple[Box, ...]:
        """The cells along the bottom, in the order of `number_cells`: from right to left."""
        y = self.height - self.thickness
        return tuple((x, y, w, h) for x, _, w, h in reversed(self.top))

    @property
    def left(self) -> tuple[Box, ...]:
        """The cells along the left, in the order of `tick_cells`: from top to bottom."""
        return tuple((0, y, self.thickness, size) for y, size in self._cells(self.height, TICKS))

    @property
    def right(self) -> tuple[Box, ...]:
        """The cells along the right, in the order of `tick_cells`: from top to bottom."""
        x = self.width - self.thickness
        return tuple((x, y, w, h) for _, y, w, h in self.left)

    def _cells(self, length: int, pairs: int) -> list[tuple[int, int]]:
        """Where the cells of ``pairs`` pairs begin along an edge, and their length."""
        size = (length - 2 * self.thickness) // (2 * pairs)
        start = (length - 2 * pairs * size) // 2
        return [(start + i * size, size) for i in range(2 * pairs)]


class Step(NamedTuple):
    """A picture that is shown for some time.

    Attributes
    ----------
    start, seconds : float
        When it is shown, from the beginning of the lead-in, and for how long.
    number : int
        Number of the pattern, or `LEAD`.
    white : bool
        Whether the rectangle is white; for the lead-in and the lead-out only.
    """

    start: float
    seconds: float
    number: int
    white: bool = False


def schedule(count: int, rate: float) -> list[Step]:
    """What is shown when: the lead-in, ``count`` patterns at ``rate`` a second, and a lead-out like the lead-in.

    Raises
    ------
    OptionError
        If there are more patterns than can be numbered.
    """
    if count > MAX_NUMBERED:
        raise OptionError(
            f"{count} patterns: a film may have {MAX_NUMBERED}; show the rest in another one",
            limit=MAX_NUMBERED,
        )
    end = sum(LEAD_SECONDS)
    patterns = [Step(end + n / rate, 1 / rate, n) for n in range(count)]
    return [*_lead(0.0), *patterns, *_lead(end + count / rate)]


def _lead(start: float) -> Iterator[Step]:
    for i, seconds in enumerate(LEAD_SECONDS):
        yield Step(start, seconds, LEAD, white=i % 2 == 1)
        start += seconds


def number_cells(number: int) -> NDArray[np.bool_]:
    """Which cells along the top and the bottom are lit for a pattern, (2 (BITS + 1),) bool.

    Notes
    -----
    They show the Gray code of number + 1, most significant bit first, and then the parity that makes the number of set
    bits even. A set bit is lit, dark; a clear one is dark, lit.
    """
    value = number + 1
    gray = value ^ (value >> 1)
    bits = [gray >> (BITS - 1 - i) & 1 for i in range(BITS)]
    return _pairs([*bits, sum(bits) & 1])


def tick_cells(number: int) -> NDArray[np.bool_]:
    """Which cells along each side are lit for a pattern, (2 TICKS,) bool: they show the lowest bit of number + 1."""
    return _pairs([(number + 1) & 1] * TICKS)


def border_light(numbers: Sequence[int]) -> NDArray[np.float32]:
    """The light of the border as it changes from pattern to pattern, (s, patterns) float32, of mean 0.

    What any mixture of cells shows is a sum of these rows and a constant. Bits that never change have no row, nor has
    the tick, which is the parity.
    """
    bits = np.array([number_cells(n)[::2] for n in numbers]).T
    lit = np.where(bits[(bits != bits[:, :1]).any(axis=1)], 1, -1)
    light: NDArray[np.float32] = (lit - lit.mean(axis=1, keepdims=True)).astype(np.float32)
    return light


def _pairs(bits: list[int]) -> NDArray[np.bool_]:
    lit = np.array(bits, bool)
    return np.stack([lit, ~lit], axis=1).ravel()


def draw_border(picture: NDArray[np.uint8], number: int, border: Border) -> NDArray[np.uint8]:
    """Draw a picture and its border on the display.

    Parameters
    ----------
    picture : (rows, columns, 1 or 3) uint8
        Stretched over the rectangle by repeating pixels.
    number : int
        Number of the pattern, or `LEAD`.
    border : Border

    Returns
    -------
    (height, width, 1 or 3) uint8
    """
    shown = np.zeros((border.height, border.width, picture.shape[2]), np.uint8)
    x, y, width, height = border.inner
    rows, columns = (
        np.arange(height) * picture.shape[0] // height,
        np.arange(width) * picture.shape[1] // width,
    )
    shown[y : y + height, x : x + width] = picture[rows[:, None], columns]
    along, beside = number_cells(number), tick_cells(number)
    for boxes, lit in (
        (border.top, along),
        (border.bottom, along),
        (border.left, beside),
        (border.right, beside),
    ):
        for i in np.flatnonzero(lit):
            left, top, across, down = boxes[i]
            shown[top : top + down, left : left + across] = 255
    return shown


def read_numbers(light: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Read the numbers of patterns from the cells along an edge, as a camera saw them.

    Parameters
    ----------
    light : (..., 2 (BITS + 1)) float
        Mean camera values of the cells of `Border.top` or `Border.bottom`, in their order, in any unit and with any
        monotonic curve. The inner half of each cell is best, because it has the least light of its neighbours.

    Returns
    -------
    number : (...) intp
        Number of the pattern, or `LEAD`; the most likely one if it is not certain.
    certain : (...) bool
        Whether every bit is clear and the parity is right. For a frame exposed across a change, this is false unless
        one of the two patterns was shown for most of the exposure.

    Notes
    -----
    A pair a, b has the contrast (a - b) / (a + b), which does not depend on its illumination. A bit is clear if its
    contrast is at least `CERTAIN` times the median, and the median is at least `FAINT`.
    """
    values = np.maximum(np.asarray(light, np.float64), 0)
    first, second = values[..., ::2], values[..., 1::2]
    contrast = (first - second) / np.maximum(first + second, np.finfo(np.float64).tiny)
    size = np.abs(contrast)
    usual = np.median(size, axis=-1, keepdims=True)
    clear = np.all((size >= CERTAIN * usual) & (usual >= FAINT), axis=-1)
    bits = contrast > 0
    even = np.count_nonzero(bits, axis=-1) % 2 == 0
    # A bit of the number is the parity of the Gray code's bits from the highest down to it.
    binary = np.cumsum(bits[..., :BITS], axis=-1) % 2
    number: NDArray[np.intp] = binary @ (1 << np.arange(BITS)[::-1]) - 1
    return number, clear & even
