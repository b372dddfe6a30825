"""How a frame is cut into tiles, and the work of one: what a dask task runs."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from storage.layout.mattes import Block, Matte, empty_block
from storage.objects.store import Objects
from workflows.images.tone_curves import Curve
from workflows.ingest.light import stack_attributes
from workflows.ingest.light.local_gain import Surroundings, local_gain
from workflows.ingest.light.measured_light import places_in, read_light
from workflows.ingest.light.observation import conditions_of, observe
from workflows.ingest.light.stack_attributes import monitor_curve_of
from workflows.mattes.cut_out import CutOut
from workflows.mattes.options import RecoveryOptions
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out, pyramid_of
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.dgsr.glare import filter_sensing
from workflows.recovery.dgsr.options import DgsrOptions
from workflows.recovery.glare import add_glare, filter_patterns, spread_patterns
from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.options import FAST
from workflows.recovery.normalise import normalise
from workflows.recovery.sensing import Patterns, Sensing
from workflows.recovery.transport import LEAST_WEIGHT

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


def cut_inside(width: int, height: int, block: int, tile: int, region: Sequence[int]) -> set[int]:
    """The numbers, as of `cut`, of the tiles that show some of a region.

    Parameters
    ----------
    width, height : int
        Of the frame.
    block : int
        Edge of a block.
    tile : int
        Edge of a tile in pixels.
    region : (x, y, width, height)
        It may reach beyond the frame.
    """
    edge = -(-tile // block) * block
    x, y, wide, high = region
    if x >= width or y >= height:
        return set()
    rows = range(y // edge, -(-min(y + high, height) // edge))
    columns = range(x // edge, -(-min(x + wide, width) // edge))
    return {row * -(-width // edge) + column for row, column in product(rows, columns)}


def recover_tile(
    objects: Objects,
    capture: str,
    matte: str,
    options: RecoveryOptions,
    index: int,
    cut_out: CutOut | None,
) -> int:
    """Recover the blocks of a matte that a tile consists of, one after another.

    What is held in memory is a block's, and what comes out is the same however blocks make up tiles.

    Parameters
    ----------
    index : int
        Of the tile.
    cut_out : CutOut or None
        Where the object stands, if only it is to be recovered.

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
    mask, pixels = mask_of(objects, capture), 0
    for row, column in product(rows, columns):
        span = target.span(row, column)
        wanted = mask[span] if cut_out is None else mask[span] & cut_out.wanted(span)
        # Of most of a frame the mask leaves everything out: values need not be read.
        if wanted.any():
            block = recover_block(objects, stack, capture, span, options, wanted)
            if cut_out is not None:
                block = cut_out.cut(block, target, span)
        else:
            block = empty_block(*wanted.shape)
        target.write(row, column, block)
        pixels += int(block.recovered.sum())
    return pixels


def recover_block(
    objects: Objects,
    stack: Stack,
    capture: str,
    span: tuple[slice, slice],
    options: RecoveryOptions,
    wanted: NDArray[np.bool_] | None = None,
) -> Block:
    """Recover a block of a matte.

    Parameters
    ----------
    span : (slice, slice)
        Rows and columns of the frame. If they have a step, frames that drift are shifted by whole pixels only.
    wanted : (h, w) bool, optional
        Which pixels to recover of those within the capture's mask; all by default.
    """
    program, monitor = program_of(objects, capture)
    attributes = stack.attributes
    noise = NoiseModel(**attributes["noise"])
    gain = gain_of(objects, capture)
    light, recovered = read_light(stack, span, program, gain, wanted)
    crosstalk = np.array(attributes["crosstalk"])
    photometry, light = observe(light, attributes, program, monitor)
    places = places_in(span, recovered)
    method, conditions = options.of_method, conditions_of(stack, program)
    patterns = patterns_of(objects, capture)
    if isinstance(method, DgsrOptions):
        # Lobes find the light of a film's border, and fit S and rho to all frames.
        found = lobes.recover(light, photometry, patterns, noise, FAST, conditions, places)
        photometry = found.photometry
        if found.stray is not None:
            light = light._replace(values=light.values - found.stray)
        sensing, constants = sensing_of(objects, capture), method.constants
        transport = dgsr.recover(light, photometry, sensing, noise, method, conditions)
        measured = normalise(light, photometry, noise, constants.least_contrast)
        error, least_weight = dgsr.composite_error(transport, photometry, measured, sensing), LEAST_WEIGHT
    else:
        found = lobes.recover(light, photometry, patterns, noise, method, conditions, places)
        transport, photometry, error = found.transport, found.photometry, found.error
        least_weight = method.least_weight
    if attributes.get("glare"):
        transport = add_glare(transport, attributes["glare"], least_weight)

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


def grid_of(objects: Objects, capture: str, options: RecoveryOptions) -> tuple[int, int]:
    """Columns and rows of the first grid of the T that a method recovers from a capture."""
    if options.method == "nn-dgsr":
        finest = sensing_of(objects, capture).levels[-1]
        return finest.columns, finest.rows
    program, _ = program_of(objects, capture)
    return pyramid_of(program, program.channels(_images_of(objects, capture))).grids[0]


@lru_cache(maxsize=2)
def program_of(objects: Objects, capture: str) -> tuple[Program, Curve]:
    """A capture's program and monitor curve, kept from tile to tile: a capture never changes."""
    attributes = Stack(objects, capture).attributes
    return stack_attributes.program_of(attributes), monitor_curve_of(attributes)


@lru_cache(maxsize=1)
def sensing_of(objects: Objects, capture: str) -> Sensing:
    """A capture's sensing matrices, as the patterns arrive through its glare."""
    program, monitor = program_of(objects, capture)
    images, glare = _images_of(objects, capture), Stack(objects, capture).attributes.get("glare")
    sensing = program.sensing(monitor, images)
    if not glare:
        return sensing
    patterns = lay_out(program, monitor, images)
    return filter_sensing(sensing, spread_patterns(patterns), glare, *patterns.pyramid.grids[0])


@lru_cache(maxsize=1)
def patterns_of(objects: Objects, capture: str) -> Patterns:
    """A capture's patterns on a pyramid, as they arrive through its glare."""
    program, monitor = program_of(objects, capture)
    attributes = Stack(objects, capture).attributes
    scaled = attributes.get("scaled", False)  # missing from stacks of earlier versions, as glare is
    patterns = lay_out(program, monitor, _images_of(objects, capture), scaled=scaled)
    glare = attributes.get("glare")
    return filter_patterns(patterns, spread_patterns(patterns), glare) if glare else patterns


@lru_cache(maxsize=1)
def mask_of(objects: Objects, capture: str) -> NDArray[np.bool_]:
    """Which pixels of a capture are to be recovered."""
    return Stack(objects, capture).mask()


@lru_cache(maxsize=1)
def gain_of(objects: Objects, capture: str) -> Surroundings | None:
    """The gain of a capture's camera at each place of its frames, if it mapped tones."""
    return local_gain(Stack(objects, capture))


def _images_of(objects: Objects, capture: str) -> list[NDArray[np.float32]]:
    return Stack(objects, capture).images()
