"""Checks of the values of an imported block."""

from collections.abc import Iterator

import numpy as np

from storage.layout.mattes import Block

BRIGHTEST = 1e20
"""Larger than any real S or rho, and small enough that sums of them fit 32-bit floats."""
TOLERANCE = 1e-4
"""Most difference between the sum of a row of T and 1; weights are 32-bit floats."""


def faults(block: Block, nodes: int) -> Iterator[tuple[str, str]]:
    """Yield each fault of a block: the name of the array, and what is wrong."""
    for name in ("S", "rho"):
        if not (np.abs(getattr(block, name)) < BRIGHTEST).all():
            yield name, "a value is infinite, not a number, or larger than any light"
    if not (block.error >= 0).all():  # infinite where nothing was recovered
        yield "error", "a value is negative, or not a number"
    if block.count[~block.recovered].any():
        yield "count", "a pixel that was left out has cells"
    if block.count[block.shared, 1:].any():
        yield "count", "a pixel whose channels share a row has cells in the others"
    if block.cell.max(initial=0) >= nodes:
        yield "cell", f"a cell is beyond the {nodes} of its grids"
    # Cells may be millions: what is computed for each takes little memory.
    sizes = block.count[block.count > 0].astype(np.int64)
    row = np.repeat(np.arange(sizes.size, dtype=np.uint32), sizes)
    if not ((block.cell[1:] > block.cell[:-1]) | (row[1:] > row[:-1])).all():
        yield "cell", "the cells of a row do not ascend"
    if not (np.isfinite(block.weight) & (block.weight > 0)).all():
        yield "weight", "a weight is not positive"
    total = np.add.reduceat(block.weight, np.cumsum(sizes) - sizes, dtype=np.float64)
    if (np.abs(total - 1) > TOLERANCE).any():
        yield "weight", "the weights of a row do not add up to 1"
