"""Composites: C = S + rho T L (eq. 5)."""

import numpy as np
from numpy.typing import NDArray

from storage.mattes import Matte
from workflows.grids import area_mean
from workflows.recovery.transport import Transport


def composite(matte: Matte, backdrop: NDArray[np.float32]) -> NDArray[np.float32]:
    """Put a matte before a backdrop.

    Parameters
    ----------
    matte : Matte
    backdrop : (h, w, 1 or 3) float32
        Linear light, 0 to 1; stretched over the monitor.

    Returns
    -------
    (height, width, 4) float32
        Linear light, and in the last channel 1 where the pixel was recovered, 0 where the mask left it out.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.

    Notes
    -----
    T's cells see the mean of the backdrop over them, which is what the patterns' blocks were to them.
    """
    light = area_mean(backdrop, matte.columns, matte.rows).reshape(matte.columns * matte.rows, -1)
    light = np.broadcast_to(light, (len(light), 3))
    picture = np.zeros((matte.height, matte.width, 4), np.float32)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            block = matte.read(row, column)
            T = Transport(matte.columns, matte.rows, block.count.reshape(-1, 3), block.cell, block.weight)
            y, x = matte.span(row, column)
            picture[y, x, :3] = block.S + block.rho * T.apply(light).reshape(block.S.shape)
            picture[y, x, 3] = block.recovered
    return picture
