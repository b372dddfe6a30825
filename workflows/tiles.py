"""How a frame is cut into tiles, and the work of one: what a dask task runs."""

from functools import lru_cache

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
from workflows.recovery.transport import Transport
from workflows.tone import Curve, table, to_light


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
    """Recover the pixels of a tile, and write the blocks of the matte that it consists of.

    Returns
    -------
    int
        Pixels recovered.

    Raises
    ------
    Corrupt
        If the store lacks the capture or the matte.
    """
    target = Matte(objects, matte)
    block_rows, block_columns = cut(target, options.tile or target.block)[index]
    (top, _), (left, _) = ((s.start, s.stop) for s in target.span(block_rows[0], block_columns[0]))
    (_, bottom), (_, right) = ((s.start, s.stop) for s in target.span(block_rows[-1], block_columns[-1]))
    stack = Stack(objects, capture)
    rows, columns = slice(top, bottom), slice(left, right)
    height, width = bottom - top, right - left

    mask = stack.mask(rows, columns)
    recovered = np.ones((height, width), bool) if mask is None else mask
    S, rho, transport = _recover(objects, capture, stack, stack.read(rows, columns)[:, recovered], options)

    # The rows of T in the order of the tile's pixels, those left out being empty.
    count = np.zeros((height, width, 3), np.uint32)
    count[recovered] = transport.count
    start = np.concatenate([[0], np.cumsum(count, dtype=np.int64)])
    frames = {"S": S, "rho": rho}
    full = {name: np.zeros((height, width, 3), np.float32) for name in frames}
    for name, values in frames.items():
        full[name][recovered] = values
    for row in block_rows:
        for column in block_columns:
            y, x = target.span(row, column)
            at = slice(y.start - top, y.stop - top), slice(x.start - left, x.stop - left)
            entries = _entries(start, height, width, at)
            target.write(
                row,
                column,
                Block(
                    full["S"][at],
                    full["rho"][at],
                    recovered[at],
                    count[at],
                    transport.cell[entries],
                    transport.weight[entries],
                ),
            )
    return int(recovered.sum())


def _entries(start: NDArray[np.int64], height: int, width: int, at: tuple[slice, slice]) -> NDArray[np.int64]:
    """Indices of the entries of T of a rectangle of a tile's pixels, in the rectangle's own order."""
    ends = start[:-1].reshape(height, width * 3), start[1:].reshape(height, width * 3)
    runs = [
        np.arange(ends[0][y, 3 * at[1].start], ends[1][y, 3 * at[1].stop - 1])
        for y in range(at[0].start, at[0].stop)
    ]
    return np.concatenate(runs)


def _recover(
    objects: Objects, capture: str, stack: Stack, codes: Codes, options: RecoveryOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32], Transport]:
    """S, rho (n, 3) float32 and T of n pixels, from their stored values (frame, n, channel)."""
    attributes = stack.attributes
    program, sensing, monitor = _program(objects.url, capture)
    camera = TypeAdapter[Curve](Curve).validate_python(attributes["camera_curve"])
    noise = Noise(**attributes["noise"])
    frames, usable, repeats = _merge(codes, np.array(attributes["patterns"]), program.count, camera)

    numbers, sent = program.constants
    photometry = fit_photometry(
        frames[:, numbers], to_light(sent, monitor), usable[:, numbers], noise, repeats[numbers]
    )
    measurements = np.ascontiguousarray(frames[:, program.measured])
    if options.method == "pyramid":
        transport = pyramid.recover(measurements, photometry, sensing, noise)
    else:
        transport = dgsr.recover(measurements, photometry, sensing, noise)
    return photometry.S, photometry.rho, transport


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
def _program(url: str, capture: str) -> tuple[Program, Sensing, Curve]:
    """A capture's program, sensing matrices and monitor curve, kept from tile to tile: a capture never changes."""
    stack = Stack(Objects(url), capture)
    program = Program.model_validate(stack.attributes["program"])
    monitor = TypeAdapter[Curve](Curve).validate_python(stack.attributes["monitor_curve"])
    return program, program.sensing(monitor, stack.images()), monitor
