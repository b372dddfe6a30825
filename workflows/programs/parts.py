"""The monitor and the parts of a pattern program, as capture.json writes them."""

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, model_validator

from workflows.images.resample import stretched_mean
from workflows.images.tone_curves import Response

MAX_BLOCKS = 4096
"""Blocks of a random grid along each axis."""
MAX_PATTERNS = 100_000
"""Patterns of a part, and of a program."""

DOT = 2
"""Side in pixels of the dots of half-tones. Smaller ones suffer more from a page that is not shown at 100 %."""

Colour = Literal["grey", "rgb"]
CHANNELS: dict[Colour, int] = {"grey": 1, "rgb": 3}
"""Pictures that a pattern shows at once, one in each channel."""

Unit = Annotated[float, Field(ge=0, le=1)]
Quarter = Annotated[float, Field(gt=0, lt=1, multiple_of=0.25)]


class Record(BaseModel):
    """Base of the models in capture.json. Fields that this version does not know are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class Monitor(Record):
    """The part of the monitor that showed the patterns, in pixels."""

    width: Annotated[int, Field(ge=1, le=16384, description="Width in pixels.", examples=[1920])]
    height: Annotated[int, Field(ge=1, le=16384, description="Height in pixels.", examples=[1080])]
    response: Response = Field(
        default="linear",
        description="Tone curve of the monitor, from value sent to light emitted: `linear`, `srgb`, a gamma, or "
        "`unknown`, which has it estimated from the constant levels.",
    )


class Constant(Record):
    """The whole monitor at one level or colour after another: one pattern for each. Give `levels` or `colours`."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": [name], "properties": {name: {"minItems": 1}}} for name in ("levels", "colours")
            ]
        }
    )
    kind: Literal["constant"] = Field(description="Says that this part is constant.")
    levels: Annotated[tuple[Unit, ...], FailFast(), Field(max_length=MAX_PATTERNS)] = Field(
        default=(),
        description="Grey values sent to the monitor, 0 (black) to 1 (white).",
        examples=[[0, 0.25, 0.5, 0.75, 1]],
    )
    colours: Annotated[tuple[tuple[Unit, Unit, Unit], ...], FailFast(), Field(max_length=MAX_PATTERNS)] = (
        Field(
            default=(),
            description="Colours sent to the monitor, each [red, green, blue] from 0 to 1.",
            examples=[[[0, 0, 0], [1, 1, 1], [1, 0, 0]]],
        )
    )

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
    """Random grids of black and white blocks. The seed determines the bits of all of them."""

    kind: Literal["bernoulli"] = Field(description="Says that this part consists of random grids.")
    columns: Annotated[int, Field(ge=1, le=MAX_BLOCKS, description="Blocks in a row.", examples=[128])]
    rows: Annotated[int, Field(ge=1, le=MAX_BLOCKS, description="Blocks in a column.", examples=[96])]
    count: Annotated[int, Field(ge=1, le=MAX_PATTERNS, description="Number of patterns.", examples=[250])]
    seed: Annotated[
        int,
        Field(
            ge=0,
            le=2**64 - 1,
            description="Seed of numpy.random.PCG64. Its raw 64-bit words, little-endian, least significant bit first, "
            "are the blocks in the order pattern, row, column, channel; 1 is lit.",
            examples=[7],
        ),
    ]
    colour: Colour = Field(
        default="grey", description="`rgb` shows three independent grids at once, one in each channel."
    )
    offset: bool = Field(
        default=False,
        description="Whether each pattern is rolled over the monitor by an offset of its own, taken from the stream "
        "after the bits: one word a pattern, low 32 bits modulo width, high 32 bits modulo height.",
    )

    @property
    def channels(self) -> int:
        return CHANNELS[self.colour]

    @property
    def bits(self) -> NDArray[np.uint8]:
        """The blocks of every pattern, (count, rows, columns, 1 or 3) uint8; 1 is lit.

        Notes
        -----
        They are the raw 64-bit words of PCG64, little-endian, least significant bit first, in the order
        (pattern, row, column, channel). `random_raw` is a stable stream; the distributions of numpy's Generator are
        not.
        """
        return np.stack([self.pattern(index) for index in range(self.count)])

    def pattern(self, index: int) -> NDArray[np.uint8]:
        """The blocks of one pattern, (rows, columns, 1 or 3) uint8, made without those of the others."""
        shape = (self.rows, self.columns, self.channels)
        size = self.rows * self.columns * self.channels
        first, within = divmod(index * size, 64)
        words = np.random.PCG64(self.seed).advance(first).random_raw(-(-(within + size) // 64)).astype("<u8")
        bits = np.unpackbits(words.view(np.uint8), bitorder="little", count=within + size)
        return bits[within:].reshape(shape)

    def offsets(self, monitor: Monitor) -> NDArray[np.int64]:
        """The offset dx, dy of each pattern in monitor pixels, (count, 2) int64; zeros without ``offset``.

        Notes
        -----
        Shown at (y, x) is P[(y + dy) % height, (x + dx) % width], where P is the pattern without its offset.
        The stream of bits continues with one word a pattern: dx is its low 32 bits modulo the monitor's width, dy
        its high 32 bits modulo the height.
        """
        if not self.offset:
            return np.zeros((self.count, 2), np.int64)
        words = np.random.PCG64(self.seed).advance(self._words).random_raw(self.count)
        low, high = words & 0xFFFFFFFF, words >> 32
        return np.stack([low % monitor.width, high % monitor.height], axis=1).astype(np.int64)

    def means(self, monitor: Monitor, columns: int, rows: int) -> Iterator[NDArray[np.float32]]:
        """The mean of each pattern, offset applied, over the cells of a grid: (rows, columns, 1 or 3) float32 each."""
        size = monitor.width, monitor.height
        for bits, (dx, dy) in zip(self.bits, self.offsets(monitor).tolist(), strict=True):
            yield stretched_mean(bits.astype(np.float32), size, columns, rows, (dx, dy))

    @property
    def _words(self) -> int:
        """The number of 64-bit words that hold the bits."""
        return -(-self.count * self.rows * self.columns * self.channels // 64)


class Stripes(Record):
    """Gray-code stripes across the monitor, from two halves to ever finer ones. No stripe is finer than a pixel."""

    kind: Literal["stripes"] = Field(description="Says that this part consists of stripes.")
    axis: Literal["x", "y"] = Field(description="The axis along which black and white alternate.")
    count: Annotated[int, Field(ge=1, le=14, description="Number of patterns.", examples=[8])]
    first: Annotated[int, Field(ge=0, le=13)] = Field(
        default=0,
        description="The stripes to start with: larger numbers leave out the coarsest ones.",
    )
    colour: Colour = Field(
        default="grey",
        description="`rgb` shows three stripes at once, one in each channel, red the coarsest.",
    )

    @property
    def channels(self) -> int:
        return CHANNELS[self.colour]

    @property
    def finest(self) -> int:
        """K: the finest pattern has 2**K stripes."""
        return self.first + self.count * self.channels

    def grid(self, index: int) -> tuple[int, int]:
        """Columns and rows of the grid that pattern ``index`` of this part lies on."""
        cells = 2 ** (self.first + (index + 1) * self.channels)
        return (cells, 1) if self.axis == "x" else (1, cells)

    def values(self, index: int) -> NDArray[np.float32]:
        """Pattern ``index`` of this part, (rows, columns, 1 or 3) float32; 1 is lit.

        Notes
        -----
        Of the K stripes, those from ``first`` on are shown, three at a time in colour. Cell s = position * 2**K //
        size along the axis is lit by stripes i where bit K - 1 - i of s ^ (s >> 1) is set. That bit depends on the
        first i + 1 bits of s alone, so stripes i lie on a grid of 2**(i + 1) cells.
        """
        columns, rows = self.grid(index)
        s = np.arange(columns * rows)
        finer = np.arange(self.channels)[::-1]  # bits that the stripes of a channel do not depend on
        bits = (s ^ (s >> 1))[:, np.newaxis] >> finer & 1
        return bits.astype(np.float32).reshape(rows, columns, self.channels)


class Halftone(Record):
    """Grey made of black and white dots, too fine for the camera: its light does not depend on the monitor's curve.

    From these patterns the camera's curve is estimated; nothing else is.
    """

    kind: Literal["halftone"] = Field(description="Says that this part consists of half-tones.")
    levels: Annotated[tuple[Quarter, ...], FailFast(), Field(min_length=1, max_length=MAX_PATTERNS)] = Field(
        description="Share of the dots that are white, one pattern for each. A dot is 2 x 2 pixels; the one at row r "
        "and column c is white if the entry at r % 2 and c % 2 of [[0, 2], [3, 1]] is below 4 times the level.",
        examples=[[0.25, 0.5, 0.75]],
    )

    @property
    def count(self) -> int:
        return len(self.levels)

    def values(self, index: int, monitor: Monitor) -> NDArray[np.float32]:
        """Pattern ``index`` of this part, (height, width, 1) float32; 1 is lit."""
        lit = (np.array([[0, 2], [3, 1]]) < 4 * self.levels[index]).astype(np.float32)
        dots = np.kron(lit, np.ones((DOT, DOT), np.float32))
        down, across = -(-monitor.height // len(dots)), -(-monitor.width // len(dots))
        return np.tile(dots, (down, across))[: monitor.height, : monitor.width, np.newaxis]


class Images(Record):
    """Patterns made by any tool, as image files in the archive, each stretched over the monitor."""

    kind: Literal["images"] = Field(description="Says that this part consists of image files.")
    files: Annotated[
        tuple[str, ...],
        FailFast(),
        Field(
            min_length=1,
            max_length=MAX_PATTERNS,
            description="Names of the images in the archive, one for each pattern.",
            examples=[["patterns/0.png", "patterns/1.png"]],
        ),
    ]

    @property
    def count(self) -> int:
        return len(self.files)


Part = Annotated[Constant | Bernoulli | Stripes | Halftone | Images, Field(discriminator="kind")]
