"""How a frame is cut into tiles, and the work of one: what a dask task runs."""

from functools import lru_cache
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.captures import Stack
from storage.mattes import Block, Matte
from storage.objects import Objects
from workflows.images import Codes
from workflows.options import RecoveryOptions
from workflows.patterns import lay_out, pyramid_of
from workflows.program import Program
from workflows.recovery import dgsr, lobes
from workflows.recovery.measured import normalise
from workflows.recovery.noise import Noise
from workflows.recovery.photometry import fit_photometry
from workflows.recovery.sensing import Patterns, Sensing
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
        block = _recover_block(stack, objects.url, capture, target.span(row, column), options)
        target.write(row, column, block)
        pixels += int(block.recovered.sum())
    return pixels


def _recover_block(
    stack: Stack, url: str, capture: str, span: tuple[slice, slice], options: RecoveryOptions
) -> Block:
    program, monitor = program_of(url, capture)
    attributes = stack.attributes
    camera = TypeAdapter[Curve](Curve).validate_python(attributes["camera_curve"])
    noise = Noise(**attributes["noise"])
    codes, recovered = stack.read_masked(*span)
    light, usable, worth = _merge(codes[:, recovered], attributes, program.count, camera)
    crosstalk = np.array(attributes["crosstalk"])
    if np.any(crosstalk != np.eye(3)):
        light = (light @ np.linalg.inv(crosstalk).T).astype(np.float32)
        usable &= usable.all(axis=2, keepdims=True)
    numbers, sent = program.constants
    filmed = np.isin(numbers, attributes["patterns"])  # a video may lack some
    numbers, sent = numbers[filmed], sent[filmed]
    photometry = fit_photometry(
        light[:, numbers], to_light(sent, monitor), usable[:, numbers], noise, worth[:, numbers]
    )
    shown = program.measured
    measurements = np.ascontiguousarray(light[:, shown])
    given = (noise, usable[:, shown], worth[:, shown])
    if options.method == "nn-dgsr":
        sensing = sensing_of(url, capture)
        transport = dgsr.recover(measurements, photometry, sensing, *given, **options.constants)
        measured = normalise(measurements, photometry, noise, options.constants["least_contrast"], *given[1:])
        error = dgsr.error_of(transport, photometry, measured, sensing)
    else:
        transport, photometry, error = lobes.recover(
            measurements, photometry, patterns_of(url, capture), *given, **options.constants
        )

    def spread(values: NDArray[Scalar], *channels: int) -> NDArray[Scalar]:
        """Values of the recovered pixels, and zeros for the others."""
        block = np.zeros((*recovered.shape, *channels), values.dtype)
        block[recovered] = values
        return block

    return Block(
        spread((photometry.S @ crosstalk.T).astype(np.float32), 3),
        spread(photometry.rho, 3),
        spread(error),
        recovered,
        spread(transport.shared),
        spread(transport.count, 3),
        transport.cell,
        transport.weight,
    )


def _merge(
    codes: Codes, attributes: dict[str, Any], count: int, camera: Curve
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """The light of each pattern, from its frames.

    Returns
    -------
    light : (n, count, 3) float32
        In units of what fills the camera's range in the shortest exposure.
    usable : (n, count, 3) bool
        False where in every exposure some frame is clipped, at black or at white, and where there is no frame.
    worth : (n, count, 3) float32
        Frames of the shortest exposure that say as much.

    Notes
    -----
    A frame that was exposed t times as long as the shortest has the value v = t x of the light x, with the variance
    ``read + shot v``. Where the photons' noise counts most, the likelihood's maximum is ``sum v / sum t``, over the
    exposures that are not clipped, with the variance ``shot x / sum t``: `worth` is ``sum t``. Read noise, which long
    exposures have less of, is then rather overstated.
    """
    look_up = table(camera, codes.dtype, attributes["storage"]["black"])
    top = np.iinfo(codes.dtype).max
    exposures = np.array(attributes["exposures"], np.float32)
    exposures /= exposures.min()
    shape = (codes.shape[1], count, 3)
    light, worth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    every, times = np.zeros(shape, np.float32), np.zeros(count, np.float32)
    of_exposure: dict[tuple[int, float], list[int]] = {}
    for frame, key in enumerate(zip(attributes["patterns"], exposures.tolist(), strict=True)):
        of_exposure.setdefault(key, []).append(frame)
    for (pattern, exposure), frames in of_exposure.items():
        total = np.zeros((shape[0], 3), np.float32)
        whole = np.ones((shape[0], 3), bool)
        for frame in frames:
            total += look_up[codes[frame]]
            whole &= (codes[frame] > 0) & (codes[frame] < top)
        time = np.float32(len(frames) * exposure)
        light[:, pattern] += np.where(whole, total, 0)
        worth[:, pattern] += np.where(whole, time, 0)
        every[:, pattern] += total
        times[pattern] += time
    usable = worth > 0
    np.copyto(worth, np.maximum(times, 1)[:, np.newaxis], where=~usable)
    np.copyto(light, every, where=~usable)
    light /= worth
    return light, usable, worth


def grid_of(url: str, capture: str, options: RecoveryOptions) -> tuple[int, int]:
    """Columns and rows of the first grid of the T that a method recovers from a capture."""
    if options.method == "nn-dgsr":
        finest = sensing_of(url, capture).levels[-1]
        return finest.columns, finest.rows
    program, _ = program_of(url, capture)
    return pyramid_of(program, program.channels(_images_of(url, capture))).grids[0]


@lru_cache(maxsize=2)
def program_of(url: str, capture: str) -> tuple[Program, Curve]:
    """A capture's program and monitor curve, kept from tile to tile: a capture never changes."""
    attributes = Stack(Objects(url), capture).attributes
    monitor = TypeAdapter[Curve](Curve).validate_python(attributes["monitor_curve"])
    return Program.model_validate(attributes["program"]), monitor


@lru_cache(maxsize=1)
def sensing_of(url: str, capture: str) -> Sensing:
    """A capture's sensing matrices."""
    program, monitor = program_of(url, capture)
    return program.sensing(monitor, _images_of(url, capture))


@lru_cache(maxsize=1)
def patterns_of(url: str, capture: str) -> Patterns:
    """A capture's patterns on a pyramid."""
    program, monitor = program_of(url, capture)
    return lay_out(program, monitor, _images_of(url, capture))


def _images_of(url: str, capture: str) -> list[NDArray[np.float32]]:
    return Stack(Objects(url), capture).images()
