"""A matte's node for Nuke without BlinkScript: blurred copies of the backdrop, looked up by STMap nodes.

Where the other group averages the backdrop over the monitor's cells, this one blurs it by Gaussians as wide as the
levels are, so it is an approximation of it.
"""

from typing import IO

from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import Plate
from workflows.composite.live.nodes.nuke import Nodes
from workflows.recovery.pyramid import Pyramid, bump_variance

NAME = "envmatte_glass_stmap"
"""Of the group of nodes."""
SIZE = 2.4
"""The size of a Gaussian of Blur, in its standard deviations."""


def write_nuke_stmap(matte: Matte, file: IO[bytes], lookups: int, plate: Plate | None = None) -> None:
    """Write the group; parameters are those of `write_nuke`.

    Notes
    -----
    A lookup takes a pixel as it is: interpolation would go by the distance to the places of the neighbouring pixels,
    which may be anywhere. So the copies have a pixel for each half of a cell, which the middle of every node is.
    """
    nodes = Nodes()
    backdrop, held = nodes.sources(matte, plate)
    cells = matte.columns, matte.rows
    variances = _variances(len(Pyramid.over(*cells).grids))
    halves = nodes.grid(
        "halves",
        (2 * cells[0] + 1, 2 * cells[1] + 1),
        *(f'"{c}/{2 * n}"' for c, n in zip("xy", cells, strict=True)),
    )
    levels = []
    for n, variance in enumerate(variances):
        sides = _size(variance, "width", cells[0]), _size(variance, "height", cells[1])
        size = "{" + " ".join(f"{{{side}}}" for side in sides) + "}"
        blurred = nodes.add("Blur", (backdrop,), name=f"blur{n}", size=size, filter="gaussian")
        levels.append(nodes.look_up(f"level{n}", blurred, halves, "Cubic"))
    arrived = None
    for k in range(lookups):
        lookup = nodes.layer(held, f"lookup{k}")
        place, seen = nodes.add("Expression", (lookup,), name=f"place{k}", **_place(*cells)), None
        for n, level in enumerate(levels):
            there = nodes.look_up(f"look{k}_{n}", level, place, "Impulse")
            share = _share(variances, n)
            shares = {f"expr{c}": f'"A{channel} * {share}"' for c, channel in enumerate("rgb")}
            part = nodes.add("MergeExpression", (place, there), name=f"share{k}_{n}", **shares)
            seen = nodes.plus(f"seen{k}_{n}", seen, part)
        assert seen is not None
        weight = nodes.layer(held, f"weight{k}")
        lit = nodes.add("Merge2", (weight, seen), name=f"lit{k}", operation="multiply")
        arrived = nodes.plus(f"add{k}", arrived, lit)
    assert arrived is not None
    nodes.finish(matte, held, arrived, plate)
    file.write(nodes.text(NAME).encode())


def _variances(levels: int) -> list[float]:
    """Of the copies of the backdrop, in squared cells: those of the levels' bumps.

    A lookup in the last one is never less than that, and up to a quarter of its squared spacing more.
    """
    return [*(bump_variance(n) for n in range(levels - 1)), bump_variance(levels - 1) + 4 ** (levels - 1) / 6]


def _size(variance: float, side: str, cells: int) -> str:
    """The size of a copy's blur along a side, as an expression of Nuke's.

    The backdrop's own pixels are boxes, of variance 1/12.
    """
    return f"{SIZE}*sqrt(max(pow(input.{side}/{cells},2)*{variance:.9g}-1/12.0,0))"


def _place(columns: int, rows: int) -> dict[str, str]:
    """The knobs of an Expression: from u, v and the level of a lookup to its place in the copies, and its variance.

    Notes
    -----
    In squared cells, a bump of level l has the variance ``4^l / 4 - 1/6``, and linear interpolation at a fraction f
    between two of them adds ``f (1 - f) 4^l``. Between two levels the variance is interpolated, as the light is.
    """

    def added(at: str) -> str:
        return f"({at}-floor({at}))*(1-({at})+floor({at}))"

    fine, coarse = (f"({added(f'across{to}')}+{added(f'down{to}')})" for to in ("", "/2-0.25"))
    variance = f"pow(4,level)*((1-b+level)*(0.25+{fine}/2)+(b-level)*(1+2*{coarse}))-1/6.0"
    temporary = {
        "level": "floor(b)",
        "across": f"r*{columns}/pow(2,level)-0.5",
        "down": f"(1-g)*{rows}/pow(2,level)-0.5",
    }
    knobs: dict[str, str] = {}
    for n, (name, value) in enumerate(temporary.items()):
        knobs |= {f"temp_name{n}": name, f"temp_expr{n}": f'"{value}"'}
    places = (f"(r*{2 * columns}+0.5)/{2 * columns + 1}", f"(g*{2 * rows}+0.5)/{2 * rows + 1}")
    return knobs | {f"expr{c}": f'"{value}"' for c, value in enumerate((*places, variance))}


def _share(variances: list[float], level: int) -> str:
    """What a copy contributes to a lookup by its variance, Bb, that the two copies next to it have together."""
    at, slopes = variances[level], []
    if level > 0:
        slopes.append(f"(Bb-{variances[level - 1]:.9g})/{at - variances[level - 1]:.9g}")
    if level + 1 < len(variances):
        slopes.append(f"({variances[level + 1]:.9g}-Bb)/{variances[level + 1] - at:.9g}")
    inner = f"min({slopes[0]},{slopes[1]})" if len(slopes) == 2 else "".join(slopes) or "1"
    return f"clamp({inner},0,1)"
