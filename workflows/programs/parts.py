"""The monitor and the parts of a pattern program, as the capture format writes them."""

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, model_validator

from workflows.images.resample import area_mean, stretch
from workflows.images.tone_curves import Response

MOST_BLOCKS = 4096
"""Of a random grid, along each axis."""
MOST_PATTERNS = 100_000
"""Of a part, and of all of a program's together."""

Unit = Annotated[float, Field(ge=0, le=1)]


class Record(BaseModel):
    """A piece of capture.json; what this version does not know is passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class Monitor(Record):
    """The monitor that the program was shown on."""

    width: Annotated[int, Field(ge=1, le=16384)]
    height: Annotated[int, Field(ge=1, le=16384)]
    response: Response = "linear"


class Constant(Record):
    """The whole monitor at one level or colour after another (Sect. 4.1)."""

    kind: Literal["constant"]
    levels: Annotated[tuple[Unit, ...], FailFast(), Field(max_length=MOST_PATTERNS)] = ()
    colours: Annotated[tuple[tuple[Unit, Unit, Unit], ...], FailFast(), Field(max_length=MOST_PATTERNS)] = ()

    @model_validator(mode="after")
    def _one_of_them(self) -> "Constant":
        if bool(self.levels) == bool(self.colours):
            raise ValueError("give either levels or colours, and at least one")
        return self

    @property
    def count(self) -> int:
        return len(self.levels) + len(self.colours)

    @property
    def values(self) -> NDArray[np.float32]:
        """(count, 3) float32: what is sent to the monitor."""
        rows = self.colours or tuple((level, level, level) for level in self.levels)
        return np.array(rows, np.float32).reshape(-1, 3)


class Bernoulli(Record):
    """Random grids of black and white blocks (Sect. 4.2.1), each rolled by an offset of its own if asked for."""

    kind: Literal["bernoulli"]
    columns: Annotated[int, Field(ge=1, le=MOST_BLOCKS)]
    rows: Annotated[int, Field(ge=1, le=MOST_BLOCKS)]
    count: Annotated[int, Field(ge=1, le=MOST_PATTERNS)]
    seed: Annotated[int, Field(ge=0, le=2**64 - 1)]
    colour: Literal["grey", "rgb"] = "grey"
    offset: bool = False

    @property
    def channels(self) -> int:
        return 3 if self.colour == "rgb" else 1

    @property
    def bits(self) -> NDArray[np.uint8]:
        """(count, rows, columns, 1 or 3) uint8, 1 is lit.

        Notes
        -----
        The raw 64-bit words of PCG64, little-endian, least significant bit first, in the order
        (pattern, row, column, channel). `random_raw` is a stable stream; Generator's distributions are not.
        """
        return np.stack([self.pattern(index) for index in range(self.count)])

    def pattern(self, index: int) -> NDArray[np.uint8]:
        """(rows, columns, 1 or 3) uint8: the bits of one pattern, in the memory of one."""
        shape = (self.rows, self.columns, self.channels)
        size = self.rows * self.columns * self.channels
        first, within = divmod(index * size, 64)
        words = np.random.PCG64(self.seed).advance(first).random_raw(-(-(within + size) // 64)).astype("<u8")
        bits = np.unpackbits(words.view(np.uint8), bitorder="little", count=within + size)
        return bits[within:].reshape(shape)

    def offsets(self, monitor: Monitor) -> NDArray[np.int64]:
        """(count, 2) int64: dx and dy of each pattern in pixels of the monitor, zeros without ``offset``.

        Notes
        -----
        What is shown at (y, x) is P[(y + dy) % height, (x + dx) % width], P the pattern without its offset.
        The stream of the bits goes on with one word a pattern: its low 32 bits modulo the monitor's width are
        dx, its high 32 bits modulo the height are dy.
        """
        if not self.offset:
            return np.zeros((self.count, 2), np.int64)
        words = np.random.PCG64(self.seed).advance(self._words).random_raw(self.count)
        low, high = words & 0xFFFFFFFF, words >> 32
        return np.stack([low % monitor.width, high % monitor.height], axis=1).astype(np.int64)

    def means(self, monitor: Monitor, columns: int, rows: int) -> Iterator[NDArray[np.float32]]:
        """The mean of each pattern with its offset over the cells of a grid, (rows, columns, 1 or 3) float32.

        One axis is averaged before the other is stretched to the monitor's pixels, which are many.
        """
        for bits, (dx, dy) in zip(self.bits, self.offsets(monitor), strict=True):
            tall = np.roll(stretch(bits.astype(np.float32), self.columns, monitor.height), -dy, axis=0)
            wide = np.roll(stretch(area_mean(tall, self.columns, rows), monitor.width, rows), -dx, axis=1)
            yield area_mean(wide, columns, rows)

    @property
    def _words(self) -> int:
        """64-bit words that hold the bits."""
        return -(-self.count * self.rows * self.columns * self.channels // 64)


class Stripes(Record):
    """Gray-code stripes across the monitor, from two halves to the finest.

    Notes
    -----
    Of K = first + count patterns, those from ``first`` on are shown. Stripe s = position * 2**K // size along the
    axis is lit in pattern i where bit K - 1 - i of s ^ (s >> 1) is set. That bit depends on the first i + 1 bits of
    s alone, so pattern i lies on a grid of 2**(i + 1) cells.
    """

    kind: Literal["stripes"]
    axis: Literal["x", "y"]
    count: Annotated[int, Field(ge=1, le=14)]
    first: Annotated[int, Field(ge=0, le=13)] = 0

    def grid(self, index: int) -> tuple[int, int]:
        """Columns and rows of the part's pattern ``index``."""
        cells = 2 ** (self.first + index + 1)
        return (cells, 1) if self.axis == "x" else (1, cells)

    def values(self, index: int) -> NDArray[np.float32]:
        """(rows, columns, 1) float32: the part's pattern ``index``, 1 is lit."""
        columns, rows = self.grid(index)
        s = np.arange(columns * rows)
        return ((s ^ (s >> 1)) & 1).astype(np.float32).reshape(rows, columns, 1)


class Images(Record):
    """Patterns from any tool, each an image stretched over the monitor."""

    kind: Literal["images"]
    files: Annotated[tuple[str, ...], FailFast(), Field(min_length=1, max_length=MOST_PATTERNS)]

    @property
    def count(self) -> int:
        return len(self.files)


Part = Annotated[Constant | Bernoulli | Stripes | Images, Field(discriminator="kind")]
