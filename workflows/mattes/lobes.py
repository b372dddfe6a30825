"""The lobes of a block of a matte."""

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Block, Matte
from workflows.recovery.lobe_table import FIELDS, ranked_lobes
from workflows.recovery.transport import Transport


def block_lobes(matte: Matte, block: Block, most: int) -> NDArray[np.float32]:
    """The lobes of a block's pixels, heaviest first.

    Returns
    -------
    (h, w, most, 8) float32
        See :func:`~workflows.recovery.lobe_table.ranked_lobes`.
    """
    width, height = matte.attributes["monitor"]
    rows = Transport(
        matte.columns,
        matte.rows,
        block.count.reshape(-1, 3),
        block.cell,
        block.weight,
        block.shared.reshape(-1),
    )
    return ranked_lobes(rows, most, height / width).reshape(*block.recovered.shape, most, len(FIELDS))
