"""What a camera saw of patterns that were shown in a border of numbers, less the border."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from workflows.programs import border
from workflows.programs.program import Program

FOLLOWS = 0.5
"""Share of a cell's variance that the numbers' bits explain (adjusted R^2), from which the cell shows the border."""

Doubles = NDArray[np.float64]


def without_border(program: Program, looks: Mapping[int, Doubles]) -> dict[int, Doubles]:
    """Leave out the cells of the frames that show the border.

    Its cells are black or white at full contrast, and would outweigh the patterns where looks are compared.

    Parameters
    ----------
    program : Program
    looks : mapping of int to (rows, columns, 3) float64
        What was seen of patterns, about in linear light.

    Returns
    -------
    dict of int to (cells, 3) float64
        All cells, if there are too few patterns to tell.

    Notes
    -----
    What a cell of the border shows, and any mixture of several, is linear in the bits of the pattern's number; random
    patterns know nothing of it. Where in the frame the border lies needs not be known.
    """
    every = {number: look.reshape(-1, 3) for number, look in looks.items()}
    numbers = [number for number in program.measured.tolist() if number in every]
    if not numbers:
        return every
    bits = np.array([[*border.code(n), *border.tick(n)] for n in numbers], float)
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
