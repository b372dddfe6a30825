"""Composites: C = S + rho T L (eq. 5)."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from storage.mattes import Matte
from workflows.grids import area_mean


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
    cells = np.broadcast_to(
        area_mean(backdrop, matte.columns, matte.rows), (matte.rows, matte.columns, 3)
    ).reshape(-1)
    picture = np.zeros((matte.height, matte.width, 4), np.float32)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            block = matte.read(row, column)
            # One product for the three channels: each channel's cells are columns of their own.
            channel = np.repeat(np.tile(np.arange(3), block.count.size // 3), block.count.ravel())
            ends = np.concatenate([[0], np.cumsum(block.count, dtype=np.int64)])
            T = csr_array(
                (block.weight, block.cell.astype(np.int64) * 3 + channel, ends),
                shape=(block.count.size, len(cells)),
            )
            y, x = matte.span(row, column)
            picture[y, x, :3] = block.S + block.rho * (T @ cells).reshape(block.S.shape)
            picture[y, x, 3] = block.recovered
    return picture
