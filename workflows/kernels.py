"""Compile every kernel now, so that later processes load it from numba's cache.

numba compiles a kernel when it is first called, for the types of that call, and keeps the result in files. Here a
capture of a few pixels goes all the way from archive to composite, through the functions that jobs and requests call.
So every kernel is called with the types that it will be called with, and no list of them has to be kept.
"""

import io
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from numba.core.registry import CPUDispatcher

from storage.layout import uploads
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.composite import composite
from workflows.composite.backdrop import backdrop_of
from workflows.composite.depth import from_two, places_of
from workflows.composite.live.encode import encode_live
from workflows.composite.placement import Placement
from workflows.composite.quantise import encode
from workflows.images import integer_formats
from workflows.images.decode import decode
from workflows.images.tone_curves import from_light
from workflows.ingest.steps import STEPS as INGEST
from workflows.jobs import Steps, Task, run
from workflows.mattes.steps import STEPS as RECOVER
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.scene import write_capture
from workflows.untrusted.limits import Limits

WIDTH, HEIGHT = 16, 12
MONITOR = 256, 192
LIMITS = Limits(unpacked=1 << 28, memory=1 << 26)


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
    """Compile every kernel that the cache lacks.

    Parameters
    ----------
    progress : callable, optional
        Is called with the share that is done, 0 to 1, and what comes next.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="envmatte-kernels-") as folder:
        objects = Objects(Path(folder).as_uri())
        progress(0, "the default recovery")
        matte = _recover(objects, "lobes")
        _composite(matte)
        progress(0.5, "the recovery of the paper")
        _recover(objects, "nn-dgsr")
        progress(0.8, "live view, depth and file formats")
        _compile_rest(matte)
    progress(1, "done")
    kernels = find_kernels()
    misses = sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
    return Compiled(len(kernels), misses, cache_folder(), time.perf_counter() - start)


def find_kernels() -> list[CPUDispatcher]:
    """All kernels of the modules that are imported."""
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{__package__}.")]
    found = (value for module in modules for value in vars(module).values())
    return list({id(value): value for value in found if isinstance(value, CPUDispatcher)}.values())


def cache_folder() -> Path:
    """The folder in which numba keeps compiled kernels: that of ``NUMBA_CACHE_DIR``, the source's or the user's."""
    return Path(os.path.commonpath([kernel.stats.cache_path for kernel in find_kernels()]))


def _recover(objects: Objects, method: str) -> Matte:
    """Ingest a capture of a glass ball and recover its matte."""
    file = io.BytesIO()
    scene = glass_ball(WIDTH, HEIGHT, monitor=MONITOR, rays=4)
    write_capture(scene, preset("sketch", *MONITOR), file)
    objects.put(uploads.part_path(method, "all"), file.getvalue())
    uploads.seal(objects, method, [uploads.Part("all", len(file.getvalue()))])
    _run(INGEST, objects, Task("job", method, "", {}, LIMITS))
    _run(RECOVER, objects, Task("job", method, method, {"method": method}, LIMITS))
    return Matte(objects, method)


def _run(steps: Steps, objects: Objects, task: Task) -> None:
    """Run all steps of a job."""
    _, plan = run(steps, objects, task, PREPARE)
    task = replace(task, plan=plan)
    for tile in range(plan["tiles"]):
        run(steps, objects, task, tile)
    run(steps, objects, task, FINISH)


def _composite(matte: Matte) -> None:
    """Composite backdrops of all types, stretched over the monitor and placed."""
    light = backdrop(*MONITOR)
    composite(matte, light)
    composite(matte, light, placement=Placement(scale=0.9))
    for dtype in (np.dtype(np.uint8), np.dtype(np.uint16)):
        codes = integer_formats.to_integers(from_light(light, "srgb"), dtype)
        picture = composite(matte, backdrop_of(codes, "srgb"))
        encode(picture, "srgb", dtype, threads=1)


def _compile_rest(matte: Matte) -> None:
    """Run what else has kernels: live view, backdrops at a depth, layers, the check of LZW."""
    encode_live(matte, threads=1)
    places = places_of(matte, threads=1)
    composite(matte, backdrop(*MONITOR), rays=from_two(places, places, (1.0, 2.0), 2.0))
    file = io.BytesIO()
    tifffile.imwrite(file, np.zeros((8, 8, 3), np.uint8), compression="lzw")
    decode(file.getvalue(), "srgb", memory=LIMITS.memory)
