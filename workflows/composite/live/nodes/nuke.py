"""A matte's node for Nuke: a group of BlinkScript nodes and arithmetic, as text that Nuke opens or pastes."""

from itertools import pairwise
from pathlib import Path
from string import Template
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import Plate
from workflows.recovery.pyramid import Pyramid

NAME = "envmatte_glass"
"""Of the group of nodes."""
_KERNELS = Path(__file__).with_name("files")
_ESCAPED = str.maketrans({c: f"\\{c}" for c in '\\"{}[]$'} | {"\n": "\\n", "\t": "\\t"})
Level = dict[str, int]


def write_nuke(matte: Matte, file: IO[bytes], lookups: int, plate: Plate | None = None) -> None:
    """Write the group.

    Parameters
    ----------
    matte : Matte
    file : IO[bytes]
    lookups : int
        Of a pixel, in the EXR that lies beside it.
    plate : Plate, optional
        Makes nodes that take a plate of the frame.
    """
    levels = _levels(matte)
    first = levels[0]
    canvas = (
        max(one["left"] + one["columns"] for one in levels),
        max(one["bottom"] + one["rows"] for one in levels),
    )
    nodes = Nodes()
    backdrop, held = nodes.sources(matte, plate)
    light = nodes.add("Constant", name="canvas", format=_format(canvas))
    light = nodes.blink("cells", "cells", (light, backdrop), columns=first["columns"], rows=first["rows"])
    for n, (fine, coarse) in enumerate(pairwise(levels), start=1):
        finer = {f"fine{name.capitalize()}": value for name, value in fine.items()}
        light = nodes.blink(f"level{n}", "halve", (light,), **coarse, **finer)
    arrived = nodes.add("Constant", name="dark", format=_format((matte.width, matte.height)))
    for k in range(lookups):
        of_lookup = (nodes.layer(held, f"lookup{k}"), nodes.layer(held, f"weight{k}"), arrived, light)
        sizes = {"columns": first["columns"], "rows": first["rows"], "levels": len(levels)}
        arrived = nodes.blink(f"add{k}", "lookup", of_lookup, **sizes)
    nodes.finish(matte, held, arrived, plate)
    file.write(nodes.text(NAME).encode())


def _levels(matte: Matte) -> list[Level]:
    """Where each level lies on the canvas: the first at the left, the others right of it, one above the other."""
    levels: list[Level] = []
    left = bottom = 0
    for columns, rows in Pyramid.over(matte.columns, matte.rows).grids:
        levels.append({"columns": columns, "rows": rows, "left": left, "bottom": bottom})
        bottom += rows if left else 0
        left = matte.columns
    return levels


def _format(size: tuple[int, int]) -> str:
    width, height = size
    return f'"{width} {height} 0 0 {width} {height} 1 envmatte_{width}x{height}"'


def _matrix(rows: ArrayLike) -> str:
    """A matrix as the value of a knob."""
    written = " ".join("{" + " ".join(f"{value:.9g}" for value in row) + "}" for row in np.asarray(rows))
    return f"{{{written}}}"


def _quoted(text: str) -> str:
    """A text as the value of a knob."""
    return f'"{text.translate(_ESCAPED)}"'


class Nodes:
    """Nodes as the text of a script, in which each takes its inputs from a stack, the first one from its top."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, kind: str, inputs: tuple[str, ...] = (), **knobs: Any) -> str:
        """Add a node; return what others find it by."""
        self._lines += [f"push ${node}" for node in reversed(inputs)]
        self._lines += [f"{kind} {{", f" inputs {len(inputs)}"]
        self._lines += [f" {name} {value}" for name, value in knobs.items()]
        self._lines += ["}", f"set N{knobs['name']} [stack 0]"]
        return f"N{knobs['name']}"

    def layer(self, image: str, name: str) -> str:
        """Add a node that shows a layer of an image as its colours."""
        return self.add("Shuffle", (image,), **{"in": name}, name=name)

    def blink(self, name: str, kernel: str, inputs: tuple[str, ...], **params: int) -> str:
        """Add a node that runs a kernel, with the defaults of its parameters."""
        source = Template((_KERNELS / f"{kernel}.blink").read_text()).substitute(params)
        return self.add("BlinkScript", inputs, name=name, kernelSource=_quoted(source))

    def grid(self, name: str, size: tuple[int, int], u: str, v: str) -> str:
        """Add what has places (u, v), expressions of x and y, in the pixels of a picture of a size."""
        canvas = self.add("Constant", name=f"{name}_canvas", format=_format(size))
        return self.add("Expression", (canvas,), name=name, expr0=u, expr1=v)

    def look_up(self, name: str, image: str, places: str, filter: str) -> str:
        """Add what an image shows at places."""
        return self.add("STMap", (image, places), name=name, channels="rgb", uv="rgb", filter=filter)

    def plus(self, name: str, one: str | None, other: str) -> str:
        """Add the sum of two nodes, the first of which may be missing."""
        return self.add("Merge2", (one, other), name=name, operation="plus") if one else other

    def sources(self, matte: Matte, plate: Plate | None) -> tuple[str, str]:
        """Add the backdrop, up to the edges of its format and repeated beyond them, and the EXR."""
        backdrop = self.add("Input", name="backdrop")
        box = "{0 0 {input.width} {input.height}}"
        backdrop = self.add("Crop", (backdrop,), name="whole", box=box, crop="false")
        if plate:
            backdrop = self._shown(backdrop, matte.attributes["monitor"], plate)
        exr = _quoted("[file dirname [value root.name]]/lookups.exr")
        return backdrop, self.add("Read", name="lookups", file=exr, raw="true")

    def _shown(self, backdrop: str, monitor: tuple[int, int], plate: Plate) -> str:
        """Add what shows the monitor a plate of the frame, by the perspective of the camera."""
        wide, high = monitor
        to_shares = [[1 / wide, 0, 0.5 / wide], [0, -1 / high, 1 - 0.5 / high], [0, 0, 1]]
        across, down, depth = (
            f"({a:.9g}*x+{b:.9g}*y+{c:.9g})" for a, b, c in plate.place @ np.array(to_shares)
        )
        u, v = f'"clamp({across}/{depth},0,1)"', f'"clamp(1-{down}/{depth},0,1)"'
        place = self.grid("monitor", (wide, high), u, v)
        return self.look_up("shown", backdrop, place, "Cubic")

    def finish(self, matte: Matte, held: str, arrived: str, plate: Plate | None) -> None:
        """Add what makes the glass of the light that arrives, and the group's output."""
        through = self.add("Merge2", (arrived, self.layer(held, "rho")), name="through", operation="multiply")
        matrix = _matrix(matte.attributes["crosstalk"])
        mixed = self.add("ColorMatrix", (through,), name="crosstalk", matrix=matrix)
        seen = self.add("Merge2", (mixed, self.layer(held, "S")), name="glass", operation="plus")
        if plate:
            seen = self.add("ColorMatrix", (seen,), name="exposed", matrix=_matrix(plate.exposure))
        whole = self.add("Copy", (seen, held), name="alpha", from0="rgba.alpha", to0="rgba.alpha")
        size = f"{{0 0 {matte.width} {matte.height}}}"
        self.add("Output", (self.add("Crop", (whole,), name="frame", box=size),), name="image")

    def text(self, name: str) -> str:
        """The group, by its name."""
        return "\n".join(["Group {", f" name {name}", " inputs 1", "}", *self._lines, "end_group", ""])
