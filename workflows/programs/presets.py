"""Programs by name, for a monitor of any size."""

from typing import Literal, NamedTuple

from storage.errors import OptionError
from workflows.programs.parts import MAX_BLOCKS
from workflows.programs.program import Bernoulli, Constant, Monitor, Program, Stripes

SEED = 7
"""Seed of the first random part; each further part adds 1."""

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


class Recipe(NamedTuple):
    """What a preset shows.

    Attributes
    ----------
    constant : Constant
        Its levels or colours are multiples of 1/255, so that 8 bits represent them exactly.
    grids : dict of int to int
        Number of patterns for each number of blocks along the monitor's shorter side: from few to many blocks, each
        number a whole multiple of the one before.
    colour, offset
        As in `Bernoulli`.
    stripes : int
        Gray-code stripes along each axis.
    """

    constant: Constant
    grids: dict[int, int]
    colour: Literal["grey", "rgb"] = "grey"
    offset: bool = True
    stripes: int = 0


EIGHT_LEVELS = Constant(kind="constant", levels=tuple(round(255 * i / 7) / 255 for i in range(8)))
COLOURS = Constant(kind="constant", colours=(BLACK, BLACK, WHITE, WHITE, RED, GREEN, BLUE))

RECIPES = {
    "default": Recipe(
        Constant(kind="constant", levels=(0, 0, 1, 1)),
        {6: 10, 12: 20, 24: 26, 48: 22, 96: 14, 192: 12, 384: 8},
        stripes=8,
    ),
    "quick": Recipe(COLOURS, {6: 6, 12: 10, 24: 10, 48: 9, 96: 7, 192: 5, 384: 2}, "rgb"),
    "sketch": Recipe(COLOURS, {6: 4, 12: 6, 24: 5, 48: 4, 96: 3, 192: 3}, "rgb"),
    "paper-250": Recipe(EIGHT_LEVELS, {12: 24, 96: 250}, offset=False),
    "paper-400": Recipe(EIGHT_LEVELS, {12: 24, 96: 400}, offset=False),
}


def preset(name: str, width: int = 1280, height: int = 960) -> Program:
    """The program of a preset.

    Parameters
    ----------
    name : str
        A key of `RECIPES`.
    width, height : int
        Size of the monitor in pixels.

    Returns
    -------
    Program
        For a monitor of unknown response.

    Raises
    ------
    OptionError
        If there is no such preset, or the monitor has fewer pixels than the coarsest grid has blocks.

    Notes
    -----
    The blocks of the coarsest grid are as square as whole numbers of them allow; finer grids split them. Grids finer
    than the pixels give their patterns to the finest grid that is not, and so do stripes finer than the pixels.
    """
    if name not in RECIPES:
        raise OptionError(f"there is no preset {name!r}: choose from {', '.join(RECIPES)}", field="preset")
    recipe = RECIPES[name]
    coarsest = min(recipe.grids)
    short, long = sorted((width, height))
    if short < coarsest:
        raise OptionError(
            f"a monitor of {width} x {height} pixels is too small for the preset {name!r}: it needs {coarsest} "
            "pixels along the shorter side",
            field="monitor",
        )
    along = min(round(coarsest * long / short), MAX_BLOCKS)
    counts: dict[tuple[int, int], int] = {}
    for blocks, count in recipe.grids.items():
        many = blocks // coarsest * along
        if blocks <= short and many <= min(long, MAX_BLOCKS):
            grid = (many, blocks) if width >= height else (blocks, many)
            counts[grid] = 0
        counts[grid] += count
    stripes = []
    axes: tuple[tuple[Literal["x", "y"], int], ...] = (("x", width), ("y", height))
    for axis, size in axes if recipe.stripes else ():
        fitting = min(recipe.stripes, size.bit_length() - 1)
        stripes.append(Stripes(kind="stripes", axis=axis, count=fitting))
        counts[grid] += recipe.stripes - fitting
    grids = [
        Bernoulli(
            kind="bernoulli",
            columns=columns,
            rows=rows,
            count=count,
            seed=SEED + i,
            colour=recipe.colour,
            offset=recipe.offset,
        )
        for i, ((columns, rows), count) in enumerate(counts.items())
    ]
    monitor = Monitor(width=width, height=height, response="unknown")
    return Program(monitor=monitor, parts=(recipe.constant, *stripes, *grids))
