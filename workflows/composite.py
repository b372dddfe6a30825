"""Composites: C = S + X (rho T L), eq. 5 with the crosstalk X between the monitor's and the camera's channels."""

import numpy as np
from numpy.typing import NDArray

from storage.mattes import Matte
from workflows.grids import area_mean
from workflows.recovery.pyramid import Pyramid
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
    light = Pyramid.over(matte.columns, matte.rows).light(area_mean(backdrop, matte.columns, matte.rows))
    light = np.broadcast_to(light, (len(light), 3))
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)
    picture = np.zeros((matte.height, matte.width, 4), np.float32)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            block = matte.read(row, column)
            T = Transport(
                matte.columns,
                matte.rows,
                block.count.reshape(-1, 3),
                block.cell,
                block.weight,
                block.shared.reshape(-1),
            )
            y, x = matte.span(row, column)
            arrived = block.rho * T.apply(light).reshape(block.S.shape)
            picture[y, x, :3] = block.S + arrived @ crosstalk.T
            picture[y, x, 3] = block.recovered
    return picture


def confidence(matte: Matte) -> NDArray[np.float32]:
    """How far a matte can be trusted.

    Returns
    -------
    (height, width) float32
        ``1 / (1 + e / 0.01)``, e the error to expect of a composite in camera units: 1/2 at 40 dB. 0 where nothing was
        recovered.
    """
    trusted = 1 / (1 + matte.layer("error") / np.float32(0.01))
    return np.where(matte.layer("recovered"), trusted, 0).astype(np.float32)
