"""A pattern program: what the monitor shows, as bits, as images, and as rows of the sensing matrix."""

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from storage.errors import OptionError
from workflows.grids import on_grid
from workflows.recovery.sensing import Level, Sensing
from workflows.tone import Curve, Response, to_light

SENSING_BYTES = 512 << 20
"""The largest sensing matrix that a worker is asked to hold."""

Unit = Annotated[float, Field(ge=0, le=1)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class Monitor(_Model):
    """The monitor that the program was shown on."""

    width: Annotated[int, Field(ge=1, le=16384)]
    height: Annotated[int, Field(ge=1, le=16384)]
    response: Response = "linear"


class Constant(_Model):
    """The whole monitor at one level or colour after another (Sect. 4.1)."""

    kind: Literal["constant"]
    levels: tuple[Unit, ...] = ()
    colours: tuple[tuple[Unit, Unit, Unit], ...] = ()

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


class Bernoulli(_Model):
    """Random grids of black and white blocks (Sect. 4.2.1)."""

    kind: Literal["bernoulli"]
    columns: Annotated[int, Field(ge=1, le=4096)]
    rows: Annotated[int, Field(ge=1, le=4096)]
    count: Annotated[int, Field(ge=1, le=100_000)]
    seed: Annotated[int, Field(ge=0, le=2**64 - 1)]
    colour: Literal["grey", "rgb"] = "grey"

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
        shape = (self.count, self.rows, self.columns, self.channels)
        n = int(np.prod(shape))
        words = np.random.PCG64(self.seed).random_raw(-(-n // 64)).astype("<u8")
        return np.unpackbits(words.view(np.uint8), bitorder="little", count=n).reshape(shape)


class Images(_Model):
    """Patterns from any tool, each an image stretched over the monitor."""

    kind: Literal["images"]
    files: Annotated[tuple[str, ...], Field(min_length=1)]

    @property
    def count(self) -> int:
        return len(self.files)


Part = Annotated[Constant | Bernoulli | Images, Field(discriminator="kind")]


class Program(_Model):
    """The patterns that a monitor shows, numbered from 0 through the parts, in order."""

    monitor: Monitor
    parts: Annotated[tuple[Part, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _usable(self) -> "Program":
        for part in self.parts:
            if isinstance(part, Bernoulli) and (
                part.columns > self.monitor.width or part.rows > self.monitor.height
            ):
                raise ValueError(f"a grid of {part.columns} x {part.rows} is finer than the monitor's pixels")
        constants = [part.values for part in self.parts if isinstance(part, Constant)]
        if not constants or np.any(np.ptp(np.concatenate(constants), axis=0) == 0):
            raise ValueError(
                "no two different constant levels: without them neither S nor rho can be told; "
                'add a part like {"kind": "constant", "levels": [0, 1]}'
            )
        if all(isinstance(part, Constant) for part in self.parts):
            raise ValueError("only constant parts: without patterns no T can be told")
        size = 4 * sum(
            p.count * p.columns * p.rows * p.channels for p in self.parts if isinstance(p, Bernoulli)
        )
        if size > SENSING_BYTES:
            raise ValueError(
                f"the patterns' blocks would take {size} bytes, more than {SENSING_BYTES}: "
                "use coarser grids or fewer patterns"
            )
        return self

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """The first pattern of each part, and at the end the number of patterns."""
        return tuple(np.cumsum([0, *(part.count for part in self.parts)]).tolist())

    @property
    def count(self) -> int:
        """The number of patterns."""
        return self.starts[-1]

    @cached_property
    def constants(self) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """The constant patterns: their numbers (k,) intp and the values sent to the monitor (k, 3) float32."""
        found = [
            (np.arange(start, start + part.count), part.values)
            for start, part in zip(self.starts, self.parts, strict=False)
            if isinstance(part, Constant)
        ]
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    def values(
        self, first: int, last: int, images: Sequence[NDArray[np.float32]] = ()
    ) -> list[NDArray[np.float32]]:
        """What is sent to the monitor for the patterns from ``first`` up to ``last``.

        Returns
        -------
        list of (rows, columns, 1 or 3) float32
            0 to 1, each on its own grid.
        """
        shown: list[NDArray[np.float32]] = []
        pictures = iter(images)
        for start, part in zip(self.starts, self.parts, strict=False):
            inside = range(max(first - start, 0), min(last - start, part.count))
            if isinstance(part, Images):
                of_part = [next(pictures) for _ in part.files]
                shown += [of_part[i] for i in inside]
            elif isinstance(part, Constant):
                shown += [part.values[i].reshape(1, 1, 3) for i in inside]
            elif inside:
                bits = part.bits
                shown += [bits[i].astype(np.float32) for i in inside]
        return shown

    def bands(self) -> list[tuple[int, int]]:
        """The columns and rows of the Bernoulli parts' grids, from coarse to fine.

        Raises
        ------
        OptionError
            If two of them do not nest.
        """
        return _nested({(part.columns, part.rows) for part in self.parts if isinstance(part, Bernoulli)})

    def sensing(
        self,
        monitor_curve: Curve,
        images: Sequence[NDArray[np.float32]] = (),
    ) -> Sensing:
        """The rows of the sensing matrix L_M (eq. 7) at every grid of the program, constants left out.

        Parameters
        ----------
        monitor_curve : Curve
            From the value sent to the light emitted.
        images : sequence of (rows, columns, 1 or 3) float32
            The images of the `Images` parts, in order, each on the coarsest grid that holds it
            (`smallest_grid`).

        Raises
        ------
        OptionError
            If the grids of two bands do not nest, or the matrices would be too large.

        Notes
        -----
        A pattern is exact on its own grid and on every finer one. An image whose grid nests in none of the
        bands' (a photograph, say) is averaged over the cells of the finest.
        """
        pictures = iter(images)
        shapes: list[tuple[int, int, int]] = []  # rows, columns, channels of each pattern
        for part in self.parts:
            if isinstance(part, Bernoulli):
                shapes += [(part.rows, part.columns, part.channels)] * part.count
            elif isinstance(part, Images):
                shapes += [next(pictures).shape for _ in part.files]
        grids = self.bands() or _nested({(columns, rows) for rows, columns, _ in shapes})
        channels = max(shape[2] for shape in shapes)
        size = sum(4 * channels * columns * rows * len(shapes) for columns, rows in grids)
        if size > SENSING_BYTES:
            raise OptionError(
                f"the program's sensing matrices would take {size} bytes, more than {SENSING_BYTES}: "
                "use coarser grids or fewer patterns",
                field="program",
                limit=SENSING_BYTES,
            )
        light = [
            to_light(v, monitor_curve)
            for start, part in zip(self.starts, self.parts, strict=False)
            if not isinstance(part, Constant)
            for v in self.values(start, start + part.count, images)
        ]
        first = [_first_level(columns, rows, grids) for rows, columns, _ in shapes]
        levels = []
        for at, (columns, rows) in enumerate(grids):
            usable = [i for i, level in enumerate(first) if level <= at]
            matrix = np.empty((channels, rows * columns, len(usable)), np.float32)
            for m, i in enumerate(usable):
                cells = on_grid(light[i], columns, rows)
                matrix[:, :, m] = np.broadcast_to(
                    cells.reshape(rows * columns, -1).T, (channels, rows * columns)
                )
            levels.append(Level(columns, rows, np.array(usable, np.intp), matrix))
        return Sensing(tuple(levels))

    @cached_property
    def measured(self) -> NDArray[np.intp]:
        """The numbers of the patterns that are not constant, in order: axis 1 of the measurements."""
        return np.setdiff1d(np.arange(self.count), self.constants[0])


def _nested(grids: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Grids from coarse to fine, each a whole multiple of the one before."""
    ordered = sorted(grids, key=lambda grid: (grid[0] * grid[1], grid))
    for coarse, fine in pairwise(ordered):
        if fine[0] % coarse[0] or fine[1] % coarse[1]:
            raise OptionError(
                f"the program's grids {coarse[0]} x {coarse[1]} and {fine[0]} x {fine[1]} do not nest: "
                "recovery goes from coarse to fine by splitting cells, so each grid must be a whole "
                "multiple of the one before",
                field="program",
            )
    return ordered


def _first_level(columns: int, rows: int, grids: list[tuple[int, int]]) -> int:
    """The coarsest grid on which a pattern of this grid is exact, or else the finest."""
    exact = (at for at, (c, r) in enumerate(grids) if c % columns == 0 and r % rows == 0)
    return next(exact, len(grids) - 1)
