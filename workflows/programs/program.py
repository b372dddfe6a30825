"""A pattern program: the patterns that a monitor shows, as pictures and as rows of the sensing matrix."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import FailFast, Field, model_validator

from workflows.images.resample import stretch, stretched_mean
from workflows.images.tone_curves import Curve, to_light
from workflows.programs.nested_grids import Shape, chain, fitting, nested, sense
from workflows.programs.parts import (
    MAX_PATTERNS,
    Bernoulli,
    Constant,
    Halftone,
    Images,
    Monitor,
    Part,
    Record,
    Stripes,
)
from workflows.recovery.sensing import Sensing

Value = TypeVar("Value", bound=np.generic)

MAX_PARTS = 1000
"""Finding the chain of their grids takes time in proportion to the square."""
SENSING_BYTES = 512 << 20
"""The largest sensing matrix."""


class Program(Record):
    """The patterns that a monitor shows, numbered from 0 through the parts, in order.

    A program has at most 100,000 patterns, two different constant levels, and a part that is not constant.
    """

    monitor: Monitor = Field(description="The monitor that the patterns are shown on.")
    parts: Annotated[
        tuple[Part, ...],
        FailFast(),
        Field(
            min_length=1, max_length=MAX_PARTS, description="The parts of the program, in the order shown."
        ),
    ]

    @model_validator(mode="after")
    def _check(self) -> "Program":
        if self.count > MAX_PATTERNS:
            raise ValueError(f"{self.count} patterns, more than the {MAX_PATTERNS} that a program may have")
        for part in self.parts:
            if isinstance(part, Bernoulli) and (
                part.columns > self.monitor.width or part.rows > self.monitor.height
            ):
                raise ValueError(f"a grid of {part.columns} x {part.rows} is finer than the monitor's pixels")
            if isinstance(part, Stripes):
                size = self.monitor.width if part.axis == "x" else self.monitor.height
                most = size.bit_length() - 1
                if part.finest > most:
                    raise ValueError(
                        f"{2**part.finest} stripes are finer than the monitor's {size} pixels along {part.axis}: "
                        f"first and {'count' if part.channels == 1 else 'three times count'} may add up to {most}"
                    )
        constants = [part.values for part in self.parts if isinstance(part, Constant)]
        if not constants or np.any(np.ptp(np.concatenate(constants), axis=0) == 0):
            raise ValueError(
                "no two different constant levels: without them neither S nor rho can be measured; "
                'add a part like {"kind": "constant", "levels": [0, 1]}'
            )
        if all(isinstance(part, Constant | Halftone) for part in self.parts):
            raise ValueError("only constant parts: without other patterns T can't be measured")
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
        """The number of the first pattern of each part, and last the number of patterns."""
        return tuple(np.cumsum([0, *(part.count for part in self.parts)]).tolist())

    @property
    def count(self) -> int:
        """The number of patterns."""
        return self.starts[-1]

    @cached_property
    def constants(self) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Numbers of the constant patterns, (k,) intp, and the values sent to the monitor, (k, 3) float32."""
        found = [
            (np.arange(start, start + part.count), part.values)
            for start, part in zip(self.starts, self.parts, strict=False)
            if isinstance(part, Constant)
        ]
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    @property
    def black(self) -> NDArray[np.intp]:
        """Numbers of the constant patterns that are black."""
        numbers, sent = self.constants
        return numbers[~sent.any(axis=1)]

    @property
    def in_colour(self) -> bool:
        """Whether any random pattern or stripes are in colour."""
        return any(part.channels > 1 for part in self.parts if isinstance(part, Bernoulli | Stripes))

    @cached_property
    def halftones(self) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Numbers of the half-tones, (k,) intp, and the share of white's light that they have, (k,) float32."""
        found = [
            (start + i, level)
            for start, part in zip(self.starts, self.parts, strict=False)
            if isinstance(part, Halftone)
            for i, level in enumerate(part.levels)
        ]
        return np.array([f[0] for f in found], np.intp), np.array([f[1] for f in found], np.float32)

    def constants_among(self, patterns: Sequence[int]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Those of the `constants` that are among ``patterns``: a video may lack some."""
        numbers, sent = self.constants
        present = np.isin(numbers, patterns)
        return numbers[present], sent[present]

    def ends(self, patterns: Sequence[int] | None = None) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Numbers of the darkest constant patterns, and of the brightest, among all or among ``patterns``."""
        numbers, sent = self.constants if patterns is None else self.constants_among(patterns)
        level = sent.sum(axis=1)
        return numbers[level == level.min()], numbers[level == level.max()]

    def tells(self, patterns: Sequence[int]) -> bool:
        """Whether these patterns suffice for S, rho and T: two different constant levels and one that is not."""
        _, sent = self.constants_among(patterns)
        return bool(len(sent) and np.ptp(sent, axis=0).all() and np.isin(self.measured, patterns).any())

    def values(
        self, first: int, last: int, images: Sequence[NDArray[np.float32]] = ()
    ) -> list[NDArray[np.float32]]:
        """The values of the patterns from ``first`` up to ``last``, as sent to the monitor.

        Returns
        -------
        list of (rows, columns, 1 or 3) float32
            0 to 1. Each pattern is on its own grid, or on the monitor's pixels if it has an offset.
        """
        return list(self._values(first, last, images))

    def pictures(
        self, first: int, last: int, images: Sequence[NDArray[np.float32]] = ()
    ) -> Iterator[NDArray[np.float32]]:
        """The pictures of the patterns from ``first`` up to ``last``, as sent to the monitor.

        Parameters
        ----------
        first, last : int
        images : sequence of (rows, columns, 1 or 3) float32
            The images of the `Images` parts, in order, of any size.

        Returns
        -------
        iterator of (height, width, 1 or 3) float32
            0 to 1, at the monitor's resolution.
        """
        return self.mapped(lambda values: values, first, last, images)

    def mapped(
        self,
        point: Callable[[NDArray[np.float32]], NDArray[Value]],
        first: int,
        last: int,
        images: Sequence[NDArray[np.float32]] = (),
    ) -> Iterator[NDArray[Value]]:
        """As `pictures`, with a function such as a tone curve applied to each value.

        The function is applied to the blocks of a pattern or to the pixels of the monitor, whichever are fewer.
        """
        pixels = self.monitor.width * self.monitor.height
        for values, offset in self._drawn(first, last, images):
            if values.shape[0] * values.shape[1] <= pixels:
                yield self._placed(point(values), offset)
            else:
                yield point(self._placed(values, offset))

    def means(
        self,
        point: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        columns: int,
        rows: int,
        first: int,
        last: int,
        images: Sequence[NDArray[np.float32]] = (),
    ) -> Iterator[NDArray[np.float32]]:
        """The means of what `mapped` gives over the cells of a grid, (rows, columns, 1 or 3) float32 each."""
        size = self.monitor.width, self.monitor.height
        for values, offset in self._drawn(first, last, images):
            yield stretched_mean(point(values), size, columns, rows, offset or (0, 0))

    def _values(
        self, first: int, last: int, images: Sequence[NDArray[np.float32]]
    ) -> Iterator[NDArray[np.float32]]:
        """As `values`, one at a time: at the monitor's resolution they may not fit into memory together."""
        for values, offset in self._drawn(first, last, images):
            yield values if offset is None else self._placed(values, offset)

    def _placed(self, values: NDArray[Value], offset: tuple[int, int] | None) -> NDArray[Value]:
        """Stretch the values of a pattern over the monitor's pixels, and apply its offset."""
        picture = stretch(values, self.monitor.width, self.monitor.height)
        return picture if offset is None else np.roll(picture, (-offset[1], -offset[0]), axis=(0, 1))

    def _drawn(
        self, first: int, last: int, images: Sequence[NDArray[np.float32]]
    ) -> Iterator[tuple[NDArray[np.float32], tuple[int, int] | None]]:
        """The patterns on their own grids, each with its offset dx, dy or None."""
        given = iter(images)
        for start, part in zip(self.starts, self.parts, strict=False):
            inside = range(max(first - start, 0), min(last - start, part.count))
            if isinstance(part, Images):
                of_part = [next(given) for _ in part.files]
                yield from ((of_part[i], None) for i in inside)
            elif isinstance(part, Constant):
                yield from ((part.values[i].reshape(1, 1, 3), None) for i in inside)
            elif isinstance(part, Stripes):
                yield from ((part.values(i), None) for i in inside)
            elif isinstance(part, Halftone):
                yield from ((part.values(i, self.monitor), None) for i in inside)
            elif inside:
                offsets = part.offsets(self.monitor)
                for i in inside:
                    dx, dy = offsets[i].tolist()
                    yield part.pattern(i).astype(np.float32), (dx, dy) if part.offset else None

    def bands(self) -> list[tuple[int, int]]:
        """Columns and rows of the nested grids of the Bernoulli parts, from coarse to fine.

        These are the grids of the parts without an offset; if there are none, the longest chain among the others that
        ends with their finest.

        Raises
        ------
        OptionError
            If two grids without an offset do not nest.
        """
        parts = [part for part in self.parts if isinstance(part, Bernoulli)]
        fixed = {(part.columns, part.rows) for part in parts if not part.offset}
        return nested(fixed) if fixed else chain({(part.columns, part.rows) for part in parts})

    def sensing(
        self,
        monitor_curve: Curve,
        images: Sequence[NDArray[np.float32]] = (),
    ) -> Sensing:
        """The rows of the sensing matrix L_M (eq. 7) on every grid of the program, without the constant patterns.

        Parameters
        ----------
        monitor_curve : Curve
            From value sent to light emitted.
        images : sequence of (rows, columns, 1 or 3) float32
            The images of the `Images` parts, in order, each on the coarsest grid that holds it
            (`smallest_grid`).

        Raises
        ------
        OptionError
            If grids without an offset do not nest, or the matrix of the coarsest level alone is too large.

        Notes
        -----
        The levels are the `bands`, or nested grids of the images and stripes if there are none. The finest levels
        are left out if the matrices would be too large with them. A pattern is exact on its own grid and on every
        finer one, and is included from the first of these on. A pattern with an offset is averaged over the cells, and
        included from the first level whose cells are no larger than its blocks. Any other pattern, such as a
        photograph, is averaged over the cells of the finest level.
        """
        shapes, channels = self._shapes(images), self.channels(images)
        grids = fitting(
            self.bands() or self._grids_of_others(images), 4 * channels * len(shapes), SENSING_BYTES
        )
        return sense(self._light(monitor_curve, images, grids[-1]), shapes, grids)

    def channels(self, images: Sequence[NDArray[np.float32]] = ()) -> int:
        """1 if every pattern that is not constant is grey, else 3."""
        return max(shape.channels for shape in self._shapes(images))

    def _light(
        self, curve: Curve, images: Sequence[NDArray[np.float32]], finest: tuple[int, int]
    ) -> Iterator[NDArray[np.float32]]:
        """The light of the patterns that are not constant: on their own grids, with an offset on the finest."""
        for start, part in zip(self.starts, self.parts, strict=False):
            if isinstance(part, Bernoulli) and part.offset:
                yield from part.means(self.monitor, *finest)  # no curve changes black and white
            elif not isinstance(part, Constant | Halftone):
                yield from (to_light(v, curve) for v in self._values(start, start + part.count, images))

    def _grids_of_others(self, images: Sequence[NDArray[np.float32]]) -> list[tuple[int, int]]:
        """Nested grids of the images and stripes, whose columns and rows are refined together.

        Both axes have their own chain, since patterns of one axis have a single column or row.
        """
        grids = {(image.shape[1], image.shape[0]) for image in images}
        stripes = [part for part in self.parts if isinstance(part, Stripes)]
        for part in stripes:
            columns, rows = part.grid(part.count - 1)
            widest = min(part.first for part in stripes) + 1
            grids |= {
                (min(2**i, columns), min(2**i, rows)) for i in range(widest, max(columns, rows).bit_length())
            }
        across = chain({(columns, 1) for columns, _ in grids if columns > 1})
        down = chain({(1, rows) for _, rows in grids if rows > 1})
        if not across or not down:
            return across or down or sorted(grids)
        return [
            (across[min(i, len(across) - 1)][0], down[min(i, len(down) - 1)][1])
            for i in range(max(len(across), len(down)))
        ]

    def _shapes(self, images: Sequence[NDArray[np.float32]]) -> list[Shape]:
        """The shapes of the patterns that are not constant."""
        given = iter(images)
        shapes: list[Shape] = []
        for part in self.parts:
            if isinstance(part, Bernoulli):
                shapes += [Shape(part.columns, part.rows, part.channels, part.offset)] * part.count
            elif isinstance(part, Stripes):
                shapes += [Shape(*part.grid(i), part.channels) for i in range(part.count)]
            elif isinstance(part, Images):
                sizes = [next(given).shape for _ in part.files]
                shapes += [Shape(columns, rows, channels) for rows, columns, channels in sizes]
        return shapes

    @cached_property
    def measured(self) -> NDArray[np.intp]:
        """Numbers of the patterns that tell T, ascending: axis 1 of the measurements."""
        return np.setdiff1d(np.arange(self.count), np.concatenate([self.constants[0], self.halftones[0]]))
