"""Compile every kernel now, so that later processes load it from numba's cache.

numba compiles a kernel when it is first called, for the types of that call, and keeps the result in files. Here a
capture of a few pixels goes from archive to matte by each method, and a matte of a few pixels through all that uses
one, by the functions that jobs and requests call. So no list of kernels and their types has to be kept.
"""

import io
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from numba.core.registry import CPUDispatcher

from storage.layout import uploads
from storage.layout.mattes import Block, Matte, create
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.composite.backdrops.backdrop import backdrop_of
from workflows.composite.backdrops.placement import Placement
from workflows.composite.depth import from_two
from workflows.composite.live.encode import encode_live
from workflows.composite.quantise import encode
from workflows.images import integer_formats
from workflows.images.decode import decode
from workflows.images.tone_curves import from_light
from workflows.ingest.steps import STEPS as INGEST
from workflows.jobs import Task, run_all
from workflows.mattes.cut_out import off_sight
from workflows.mattes.lobes import transport_of
from workflows.mattes.perspective import places_of
from workflows.mattes.steps import STEPS as RECOVER
from workflows.programs.presets import preset
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.glare import WIDTHS, add_glare, filter_patterns, spread_patterns
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.scene import write_capture
from workflows.threads import CORES
from workflows.untrusted.limits import Limits

WIDTH, HEIGHT = 16, 12
MONITOR = 256, 192
LIMITS = Limits(unpacked=1 << 28, memory=1 << 26)
POLL = 0.5
"""Seconds between two counts of the kernels that are there."""


class Compiled(NamedTuple):
    """What `compile_kernels` has done.

    Attributes
    ----------
    kernels : int
        All kernels.
    compiled : int
        How many types of calls were compiled, because the cache lacked them.
    cache : Path
        The folder of the cache.
    seconds : float
        How long it took.
    """

    kernels: int
    compiled: int
    cache: Path
    seconds: float


def compile_kernels(progress: Callable[[float, str], None] = lambda share, what: None) -> Compiled:
    """Compile every kernel that the cache lacks, on all cores.

    Parameters
    ----------
    progress : callable, optional
        Is called with the share that is done, 0 to 1, and what is under way.
    """
    start, began = time.perf_counter(), time.time()
    # Those that are inlined become a part of what calls them, and have no entry of their own.
    entries = sum(kernel.targetoptions.get("inline") != "always" for kernel in find_kernels())
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(CORES, len(PARTS)), context) as pool:
        left = {pool.submit(_compile, part): part for part in PARTS}
        misses = 0
        while left:
            progress(min(_written_since(began) / entries, 0.99), ", ".join(left.values()))
            done, _ = wait(left, POLL, FIRST_COMPLETED)
            for future in done:
                misses += future.result()
                del left[future]
    progress(1, "done")
    return Compiled(len(find_kernels()), misses, cache_folder(), time.perf_counter() - start)


def find_kernels() -> list[CPUDispatcher]:
    """All kernels of the modules that are imported."""
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{__package__}.")]
    found = (value for module in modules for value in vars(module).values())
    return list({id(value): value for value in found if isinstance(value, CPUDispatcher)}.values())


def cache_folder() -> Path:
    """The folder in which numba keeps compiled kernels: that of ``NUMBA_CACHE_DIR``, the source's or the user's."""
    return Path(os.path.commonpath([kernel.stats.cache_path for kernel in find_kernels()]))


def _written_since(began: float) -> int:
    """How many kernels the cache has got since a time."""
    return sum(file.stat().st_mtime >= began for file in cache_folder().rglob("*.nbi"))


def _compile(part: str) -> int:
    """Compile the kernels of a part, one of `PARTS`; returns how many types of calls the cache lacked."""
    with tempfile.TemporaryDirectory(prefix="envmatte-kernels-") as folder:
        PARTS[part](Objects(Path(folder).as_uri()))
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in find_kernels())


def recover(objects: Objects) -> None:
    """Ingest a capture of a glass ball, and recover its matte by each method."""
    file = io.BytesIO()
    scene = glass_ball(WIDTH, HEIGHT, monitor=MONITOR, rays=4)
    write_capture(scene, preset("sketch", *MONITOR), file)
    objects.put(uploads.part_path("c", "all"), file.getvalue())
    uploads.seal(objects, "c", [uploads.Part("all", len(file.getvalue()))])
    run_all(INGEST, objects, Task("job", "c", "", {}, LIMITS))
    for method in ("lobes", "nn-dgsr"):
        run_all(RECOVER, objects, Task("job", "c", method, {"method": method}, LIMITS))


def use_matte(objects: Objects) -> None:
    """Composite backdrops of all types with a matte, and do what else has kernels."""
    matte = _matte(objects)
    light = backdrop(*MONITOR)
    composite(matte, light)
    composite(matte, light, placement=Placement(scale=0.9))
    for dtype in (np.dtype(np.uint8), np.dtype(np.uint16)):
        codes = integer_formats.to_integers(from_light(light, "srgb"), dtype)
        picture = composite(matte, backdrop_of(codes, "srgb"))
        encode(picture, "srgb", dtype, threads=1)
    encode_live(matte, threads=1)
    shares = [0.01] * (len(WIDTHS) + 1)  # few captures have any glare
    add_glare(transport_of(matte, matte.read(0, 0)), shares)
    patterns = lay_out(preset("sketch", *MONITOR), "linear", scaled=True)
    filter_patterns(patterns, spread_patterns(patterns), shares)
    off_sight(matte.read(0, 0), matte, np.zeros((HEIGHT, WIDTH, 2)), pitch=0.01, aspect=0.75)
    places = places_of(matte, threads=1)
    composite(matte, light, rays=from_two(places, places, (1.0, 2.0), 2.0))
    file = io.BytesIO()
    tifffile.imwrite(file, np.zeros((8, 8, 3), np.uint8), compression="lzw")
    decode(file.getvalue(), "srgb", memory=LIMITS.memory)


def _matte(objects: Objects) -> Matte:
    """A matte of one block whose pixels see two cells each."""
    matte = create(
        objects,
        "m",
        height=HEIGHT,
        width=WIDTH,
        columns=64,
        rows=48,
        monitor=MONITOR,
        crosstalk=np.eye(3).tolist(),
    )
    shape = HEIGHT, WIDTH
    ones, count = np.ones((*shape, 3), np.float32), np.full((*shape, 3), 2, np.uint32)
    cells = np.tile(np.array([3, 70], np.uint32), ones.size)
    weights = np.full(cells.size, 0.5, np.float32)
    whole = np.ones(shape, bool)
    matte.write(0, 0, Block(0 * ones, ones, 0 * ones[..., 0], whole, ~whole, count, cells, weights))
    return Matte(objects, "m")


PARTS: dict[str, Callable[[Objects], None]] = {
    "the recovery of mattes": recover,
    "composites, live view and depth": use_matte,
}
"""What has kernels of its own, by what it is: compiled side by side, the longest first."""
