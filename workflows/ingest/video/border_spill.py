"""The cells of a frame that see the numbered border, to be left out when patterns are compared."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from workflows.programs.border import number_cells, tick_cells
from workflows.programs.program import Program

FOLLOWS = 0.5
"""A cell sees the border if the bits of the numbers explain this share of its variance (adjusted R^2)."""

Doubles = NDArray[np.float64]


def without_border(program: Program, looks: Mapping[int, Doubles]) -> dict[int, Doubles]:
    """Leave out the cells of the frames that see the border.

    The border's cells are black or white at full contrast, and would outweigh the patterns in comparisons.

    Parameters
    ----------
    program : Program
    looks : mapping of int to (rows, columns, 3) float64
        What the camera saw of patterns, in approximately linear light.

    Returns
    -------
    dict of int to (cells, 3) float64
        All cells if there are too few patterns to decide.

    Notes
    -----
    What a cell of the border shows, and any mixture of such cells, is linear in the bits of the pattern's number, with
    which random patterns are uncorrelated. It is not necessary to know where in the frame the border lies.
    """
    every = {number: look.reshape(-1, 3) for number, look in looks.items()}
    numbers = [number for number in program.measured.tolist() if number in every]
    if not numbers:
        return every
    bits = np.array([[*number_cells(n), *tick_cells(n)] for n in numbers], float)
    bits -= bits.mean(axis=0)
    directions, lengths, _ = np.linalg.svd(bits, full_matrices=False)
    directions = directions[:, lengths > 1e-6 * lengths[0]]
    freedom = len(numbers) - 1 - directions.shape[1]
    if freedom < directions.shape[1]:
        return every
    seen = np.stack([every[number] for number in numbers])
    seen -= seen.mean(axis=0)
    whole = (seen**2).sum(axis=(0, 2))
    explained = (np.tensordot(directions, seen, (0, 0)) ** 2).sum(axis=(0, 2))
    # adjusted R^2 > FOLLOWS
    follows = (whole - explained) * (len(numbers) - 1) < (1 - FOLLOWS) * whole * freedom
    return every if follows.all() else {number: look[~follows] for number, look in every.items()}
