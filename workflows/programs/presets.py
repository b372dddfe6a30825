"""Programs by name, for a monitor of any size."""

from typing import Literal, NamedTuple

from storage.errors import OptionError
from workflows.programs.parts import (
    CHANNELS,
    MAX_BLOCKS,
    Bernoulli,
    Colour,
    Constant,
    Halftone,
    Monitor,
    Part,
    Stripes,
)
from workflows.programs.program import Program

SEED = 7
"""Seed of the first random part; each further part adds 1."""

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

AT_FIRST = Constant(kind="constant", colours=(WHITE, RED, GREEN, BLUE, BLACK))
"""White is first, because a film begins after black, and black is not next, so that it is not taken for a lead-in."""
HALFTONES = Halftone(kind="halftone", levels=(0.25, 0.5, 0.75))
AGAIN = Constant(kind="constant", levels=(1, 0))
"""Shown again in the middle, because exposure and the light of the room may change meanwhile."""
AT_LAST = Constant(kind="constant", levels=(0, 1))
"""And at the end: white is last, because black follows in a film."""
AT_ONCE = 4
"""Patterns of stripes along one axis before those along the other: so few tell the place along both, if coarsely."""
EIGHT_LEVELS = Constant(kind="constant", levels=tuple(round(255 * i / 7) / 255 for i in range(8)))


class Recipe(NamedTuple):
    """What a preset shows.

    Attributes
    ----------
    grids : dict of int to int
        Number of patterns for each number of blocks along the monitor's shorter side: from few to many blocks, each
        number a whole multiple of the one before.
    colour, offset
        As in `Bernoulli`.
    stripes : int
        Patterns of Gray-code stripes along each axis.
    calibrated : bool
        Whether the patterns that calibrate the camera are shown; if not, `EIGHT_LEVELS`, as in the paper.
    """

    grids: dict[int, int]
    colour: Colour = "grey"
    offset: bool = True
    stripes: int = 0
    calibrated: bool = True


RECIPES = {
    "default": Recipe({6: 10, 12: 20, 24: 26, 48: 22, 96: 14, 192: 12, 384: 8}, stripes=8),
    "quick": Recipe({6: 5, 12: 8, 24: 9, 48: 8, 96: 6, 192: 5, 384: 2}, "rgb", stripes=3),
    "sketch": Recipe({6: 3, 12: 4, 24: 4, 48: 3, 96: 3, 192: 2}, "rgb", stripes=3),
    "paper-250": Recipe({12: 24, 96: 250}, offset=False, calibrated=False),
    "paper-400": Recipe({12: 24, 96: 400}, offset=False, calibrated=False),
}
IN_GREY = {
    "quick": Recipe({12: 8, 24: 9, 48: 8, 96: 4, 192: 2, 384: 2}, stripes=8),
    "sketch": Recipe({12: 3, 24: 3, 48: 2, 96: 1}, stripes=8),
}
"""What films and JPEG stills show in place of presets in colour, with as many frames: both store colour at half the
resolution, so that what a pixel sees of one colour is mixed with its neighbours'."""


def preset(name: str, width: int = 1280, height: int = 960, *, grey: bool = False) -> Program:
    """The program of a preset.

    Parameters
    ----------
    name : str
        A key of `RECIPES`.
    width, height : int
        Size of the monitor in pixels.
    grey : bool
        Whether it must be in black and white.

    Returns
    -------
    Program
        For a monitor of unknown response.

    Raises
    ------
    OptionError
        If there is no such preset, or the monitor has fewer pixels than the coarsest grid has blocks.
    """
    if name not in RECIPES:
        raise OptionError(f"there is no preset {name!r}: choose from {', '.join(RECIPES)}", field="preset")
    recipe = IN_GREY.get(name, RECIPES[name]) if grey else RECIPES[name]
    coarsest = min(recipe.grids)
    if min(width, height) < coarsest:
        raise OptionError(
            f"a monitor of {width} x {height} pixels is too small for the preset {name!r}: it needs {coarsest} "
            "pixels along the shorter side",
            field="monitor",
        )
    stripes, grids = stripes_and_grids(recipe, width, height)
    patterns: tuple[Part, ...] = (*stripes, *grids)
    # Stripes come before: with them, half of the patterns have been shown after one grid less.
    middle = len(stripes) + (len(grids) - 1 if stripes else len(grids) + 1) // 2
    parts: tuple[Part, ...] = (EIGHT_LEVELS, *patterns)
    if recipe.calibrated:
        parts = (AT_FIRST, HALFTONES, *patterns[:middle], AGAIN, *patterns[middle:], AT_LAST)
    return Program(monitor=Monitor(width=width, height=height, response="unknown"), parts=parts)


def stripes_and_grids(recipe: Recipe, width: int, height: int) -> tuple[list[Stripes], list[Bernoulli]]:
    """The patterns of a recipe that tell T, without those that calibrate the camera.

    Parameters
    ----------
    recipe : Recipe
    width, height : int
        Size of the monitor in pixels, the shorter side at least the number of blocks of the coarsest grid.

    Returns
    -------
    stripes : list of Stripes
    grids : list of Bernoulli
        From coarse to fine.

    Notes
    -----
    The blocks of the coarsest grid are as square as whole numbers of them allow; finer grids split them. Grids finer
    than the pixels give their patterns to the finest grid that is not, and so do stripes finer than the pixels.
    """
    coarsest = min(recipe.grids)
    short, long = sorted((width, height))
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
    channels = CHANNELS[recipe.colour]
    for first in range(0, recipe.stripes, AT_ONCE):
        for axis, size in axes:
            wanted = min(AT_ONCE, recipe.stripes - first)
            fitting = max(min(wanted, (size.bit_length() - 1) // channels - first), 0)
            if fitting:
                stripes.append(
                    Stripes(
                        kind="stripes",
                        axis=axis,
                        count=fitting,
                        first=first * channels,
                        colour=recipe.colour,
                    )
                )
            counts[grid] += wanted - fitting
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
    return stripes, grids
