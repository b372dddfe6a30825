"""Programs and capture archives for tests."""

import io
import zipfile
from collections.abc import Mapping, Sequence

import numpy as np

from workflows.programs.program import Bernoulli, Constant, Monitor, Program


def nested_program(
    monitor: tuple[int, int] = (1280, 960),
    *,
    bands: Sequence[tuple[int, int, int]],
    levels: int = 8,
    seed: int = 7,
) -> Program:
    """A program of constant levels and random grids without offsets.

    Parameters
    ----------
    monitor : (int, int)
        Width and height in pixels.
    bands : sequence of (columns, rows, count)
        From coarse to fine, each grid a whole multiple of the one before.
    levels : int
        Constant levels from 0 to 1, at least 2.
    seed : int
        Of the first band; each further band adds 1.
    """
    grids = [
        Bernoulli(kind="bernoulli", columns=columns, rows=rows, count=count, seed=seed + i)
        for i, (columns, rows, count) in enumerate(bands)
    ]
    constant = Constant(kind="constant", levels=tuple(np.linspace(0, 1, levels).round(6).tolist()))
    return Program(monitor=Monitor(width=monitor[0], height=monitor[1]), parts=(constant, *grids))


def zip_bytes(files: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A ZIP of files with a fixed date: the same files give the same bytes."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return target.getvalue()
