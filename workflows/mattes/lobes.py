"""T of the pixels of a matte's block, and their lobes."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Block
from workflows.interruption import checkpoint
from workflows.recovery.clusters.lobe_table import FIELDS, ranked_lobes
from workflows.recovery.transport import Transport


class Gridded(Protocol):
    """A matte, stored or in an archive: what its cells mean."""

    attributes: dict[str, Any]
    columns: int
    rows: int


def transport_of(matte: Gridded, block: Block) -> Transport:
    """T of a block's pixels, in the order (y, x)."""
    count, shared = block.count.reshape(-1, 3), block.shared.reshape(-1)
    return Transport(matte.columns, matte.rows, count, block.cell, block.weight, shared)


def block_lobes(matte: Gridded, block: Block, most: int) -> NDArray[np.float32]:
    """The lobes of a block's pixels, heaviest first.

    Returns
    -------
    (h, w, most, 8) float32
        See :func:`~workflows.recovery.clusters.lobe_table.ranked_lobes`.
    """
    width, height = matte.attributes["monitor"]
    lobes = ranked_lobes(transport_of(matte, block), most, height / width, checkpoint)
    return lobes.reshape(*block.recovered.shape, most, len(FIELDS))
