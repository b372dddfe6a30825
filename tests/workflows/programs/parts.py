"""Programs and their parts, as capture.json has them, in few words."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workflows.programs.program import Program


def program(*parts: dict[str, Any], width: int = 96, height: int = 72) -> Program:
    constant = {"kind": "constant", "levels": [0, 1]}
    monitor = {"width": width, "height": height}
    return Program.model_validate({"monitor": monitor, "parts": [constant, *parts]})


def grid(
    columns: int, rows: int, count: int = 3, seed: int = 7, colour: str = "grey", offset: bool = False
) -> dict[str, Any]:
    return {
        "kind": "bernoulli",
        "columns": columns,
        "rows": rows,
        "count": count,
        "seed": seed,
        "colour": colour,
        "offset": offset,
    }


def stripes(axis: str, count: int, first: int = 0, colour: str = "grey") -> dict[str, Any]:
    return {"kind": "stripes", "axis": axis, "count": count, "first": first, "colour": colour}


def shown(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """A pattern on the monitor's pixels, by the rule of the format."""
    rows, columns, _ = values.shape
    y, x = np.arange(height)[:, None], np.arange(width)
    return values[y * rows // height, x * columns // width]
