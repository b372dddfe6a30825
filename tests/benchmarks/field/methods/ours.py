"""This project's recoveries, and solvers of libraries in their place, on random grids from coarse to fine."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np

from tests.benchmarks.field.methods.method import Film, Floats, Matte
from tests.benchmarks.field.methods.method import Program as Patterns
from tests.benchmarks.recovery.solvers import Recover
from workflows.images.resample import area_mean
from workflows.programs.parts import Bernoulli, Constant, Monitor
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry, estimate_noise, fit_photometry
from workflows.recovery.lobes import recover as lobes
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport


@dataclass(frozen=True, eq=False)
class EngineMatte:
    """A matte as the service composites it."""

    photometry: Photometry
    transport: Transport

    @property
    def bytes(self) -> int:
        T = self.transport
        return self.photometry.S.nbytes + self.photometry.rho.nbytes + T.cell.nbytes + T.weight.nbytes

    def composite(self, light: Floats) -> Floats:
        grid = self.transport.columns, self.transport.rows
        nodes = Pyramid.over(*grid).light(area_mean(light, *grid))
        return self.photometry.S + self.photometry.rho * self.transport.apply(nodes)


@dataclass
class Engine:
    """A program of random grids, and a recovery in the engine's form; by default of lobes."""

    name: str
    wanted: str | dict[tuple[int, int], int]
    """A preset, or the number of patterns on each grid, after eight grey levels."""
    solve: Recover | None = None
    filmed: bool = False
    """Whether the preset is shown as it is to cameras that film."""
    shown: Program = field(init=False)

    def program(self, columns: int, rows: int) -> Patterns:
        monitor = Monitor(width=columns, height=rows)
        if isinstance(self.wanted, str):
            self.shown = preset(self.wanted, columns, rows, grey=self.filmed).model_copy(
                update={"monitor": monitor}
            )
        else:
            levels = Constant(kind="constant", levels=tuple(i / 7 for i in range(8)))
            grids = [
                Bernoulli(kind="bernoulli", columns=wide, rows=high, count=count, seed=7 + i)
                for i, ((wide, high), count) in enumerate(self.wanted.items())
            ]
            self.shown = Program(monitor=monitor, parts=(levels, *grids))
        pictures = list(self.shown.pictures(0, self.shown.count))
        wide = max(picture.shape[2] for picture in pictures)
        stacked = np.stack([np.broadcast_to(picture, (rows, columns, wide)) for picture in pictures])
        yield np.round(255 * stacked).astype(np.uint8)

    def recover(self, film: Film) -> Matte:
        light = PatternLight.of(film.values, (film.values > 0) & (film.values < 1))
        numbers, levels = self.shown.constants
        constant, measured = light.of_patterns(numbers), light.of_patterns(self.shown.measured)
        noise = estimate_noise(constant.values, levels, constant.usable, film.step)
        photometry = fit_photometry(constant, levels, noise)
        if self.solve is None:
            patterns = lay_out(self.shown, "linear")
            found = lobes.recover(measured, photometry, patterns, noise)
            return EngineMatte(photometry, found.transport)
        every = PatternLight.of(measured.values)  # the solvers leave nothing out
        T = self.solve(every, photometry, self.shown.sensing("linear"), noise)
        return EngineMatte(photometry, cast(Transport, T))
