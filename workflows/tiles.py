"""How a frame is cut into tiles, and the work of one: what a dask task runs."""

from functools import lru_cache
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.captures import Stack
from storage.mattes import Block, Matte
from storage.objects import Objects
from workflows.images import Codes
from workflows.options import RecoveryOptions
from workflows.program import Program
from workflows.recovery import dgsr, pyramid
from workflows.recovery.photometry import Noise, fit_photometry
from workflows.recovery.sensing import Sensing
from workflows.tone import Curve, table, to_light

Scalar = TypeVar("Scalar", bound=np.generic)


def cut(matte: Matte, tile: int) -> list[tuple[range, range]]:
    """The tiles of a matte, row by row, each a rectangle of its blocks.

    Parameters
    ----------
    tile : int
        Edge of a tile in pixels, rounded up to whole blocks.

    Returns
    -------
    list of (range, range)
        Block rows and block columns.
    """
    edge = -(-tile // matte.block)
    return [
        (
            range(row, min(row + edge, matte.block_rows)),
            range(column, min(column + edge, matte.block_columns)),
        )
        for row in range(0, matte.block_rows, edge)
        for column in range(0, matte.block_columns, edge)
    ]


def recover_tile(objects: Objects, capture: str, matte: str, options: RecoveryOptions, index: int) -> int:
    """Recover the blocks of a matte that a tile consists of, one after another.

    What is held in memory is a block's, and what comes out is the same however blocks make up tiles.

    Returns
    -------
    int
        Pixels recovered.

    Raises
    ------
    Corrupt
        If the store lacks the capture or the matte.
    """
    target, stack = Matte(objects, matte), Stack(objects, capture)
    rows, columns = cut(target, options.tile or target.block)[index]
    pixels = 0
    for row, column in product(rows, columns):
        block = _recover_block(stack, target.span(row, column), program_of(objects.url, capture), options)
        target.write(row, column, block)
        pixels += int(block.recovered.sum())
    return pixels


def _recover_block(
    stack: Stack,
    span: tuple[slice, slice],
    shown: tuple[Program, Sensing, Curve],
    options: RecoveryOptions,
) -> Block:
    program, sensing, monitor = shown
    attributes = stack.attributes
    camera = TypeAdapter[Curve](Curve).validate_python(attributes["camera_curve"])
    noise = Noise(**attributes["noise"])
    codes, mask = stack.read(*span), stack.mask(*span)
    recovered = np.ones(codes.shape[1:3], bool) if mask is None else mask
    light, usable, repeats = _merge(
        codes[:, recovered], np.array(attributes["patterns"]), program.count, camera
    )
    numbers, sent = program.constants
    photometry = fit_photometry(
        light[:, numbers], to_light(sent, monitor), usable[:, numbers], noise, repeats[numbers]
    )
    measurements = np.ascontiguousarray(light[:, program.measured])
    if options.method == "pyramid":
        transport = pyramid.recover(measurements, photometry, sensing, noise)
    else:
        transport = dgsr.recover(measurements, photometry, sensing, noise)

    def spread(values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Values of the recovered pixels, and zeros for the others."""
        block = np.zeros((*recovered.shape, 3), values.dtype)
        block[recovered] = values
        return block

    return Block(
        spread(photometry.S),
        spread(photometry.rho),
        recovered,
        spread(transport.count),
        transport.cell,
        transport.weight,
    )


def _merge(
    codes: Codes, patterns: NDArray[np.intp], count: int, camera: Curve
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.intp]]:
    """The mean light of each pattern's frames.

    Returns
    -------
    light : (n, count, 3) float32
    usable : (n, count, 3) bool
        False where a frame is clipped, at black or at white.
    repeats : (count,) intp
        Frames of each pattern.
    """
    look_up = table(camera, codes.dtype)
    n = codes.shape[1]
    light = np.zeros((n, count, 3), np.float32)
    usable = np.ones((n, count, 3), bool)
    top = np.iinfo(codes.dtype).max
    for frame, pattern in zip(codes, patterns, strict=True):
        light[:, pattern] += look_up[frame]
        usable[:, pattern] &= (frame > 0) & (frame < top)
    repeats = np.bincount(patterns, minlength=count)
    light /= repeats[:, np.newaxis].astype(np.float32)
    return light, usable, repeats


@lru_cache(maxsize=2)
def program_of(url: str, capture: str) -> tuple[Program, Sensing, Curve]:
    """A capture's program, sensing matrices and monitor curve, kept from tile to tile: a capture never changes."""
    stack = Stack(Objects(url), capture)
    program = Program.model_validate(stack.attributes["program"])
    monitor = TypeAdapter[Curve](Curve).validate_python(stack.attributes["monitor_curve"])
    return program, program.sensing(monitor, stack.images()), monitor
