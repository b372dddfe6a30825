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
    """Write the group; parameters are those of `write_nuke`."""
    nodes = Nodes()
    backdrop, held = nodes.sources(matte, plate)
    levels = []
    for n in range(len(Pyramid.over(matte.columns, matte.rows).grids)):
        sides = _size(n, "width", matte.columns), _size(n, "height", matte.rows)
        size = "{" + " ".join(f"{{{side}}}" for side in sides) + "}"
        levels.append(nodes.add("Blur", (backdrop,), name=f"level{n}", size=size, filter="gaussian"))
    arrived = None
    for k in range(lookups):
        place, seen = nodes.layer(held, f"lookup{k}"), None
        for n, level in enumerate(levels):
            there = nodes.add(
                "STMap", (level, place), name=f"look{k}_{n}", channels="rgb", uv="rgb", filter="Impulse"
            )
            share = f"max(1 - abs(Bb - {n}), 0)"
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


def _size(level: int, side: str, cells: int) -> str:
    """The size of a level's blur along a side, as an expression of Nuke's.

    Notes
    -----
    Linear interpolation between nodes adds 1/6 of a squared spacing to the variance of their bumps, on average over the
    places. The backdrop's own pixels are boxes, of variance 1/12.
    """
    variance = bump_variance(level) + 4**level / 6  # of squared cells of the first level
    return f"{SIZE}*sqrt(max(pow(input.{side}/{cells},2)*{variance:.6g}-1/12.0,0))"
