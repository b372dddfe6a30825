"""What draws the glass without a service, beside the service's composites: figures of two READMEs.

    python -m tests.benchmarks.compositing.without_service

prints the PSNR of Nuke's node without BlinkScript, run by numpy (the README of the nodes), and of the notebook's
composite by lobes, before each backdrop; and how much of a full-HD archive `envmatte.open` reads (the README of
`services/client/envmatte`). Blender's nodes have a benchmark of their own.
"""

import contextlib
import tempfile
import time
from pathlib import Path

import dask
import envmatte
import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Block
from storage.objects.store import Objects
from tests.services.client.envmatte.test_notebook import measure_lobes
from tests.workflows.composite.live.nodes.drawing import recovered
from tests.workflows.composite.live.nodes.test_nuke import measure_blurs
from tests.workflows.mattes.imports.test_archived import Watched
from workflows.recovery.pyramid import Pyramid

WIDTH, HEIGHT, CELLS = 1920, 1080, 8
"""A frame, and the cells of each of its pixels."""


def main() -> None:
    for glass in ("ball", "lens", "tumbler"):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            with contextlib.chdir(folder):
                _print(f"{glass}, notebook", measure_lobes(Objects((folder / "a").as_uri()), glass))
            matte = recovered(Objects((folder / "b").as_uri()), glass)
            for lookups in (16, 4):
                (nodes := folder / str(lookups)).mkdir()
                _print(f"{glass}, Nuke by {lookups} STMaps", measure_blurs(matte, nodes, lookups))
    with tempfile.TemporaryDirectory() as name:
        _measure_reading(Path(name))


def _print(what: str, found: dict[str, float]) -> None:
    print(f"{what}: { ({kind: round(value, 1) for kind, value in found.items()}) }", flush=True)


def _measure_reading(folder: Path) -> None:
    """Print the bytes and the seconds of opening an archive, and of reading a pixel of it."""
    _write(Objects(folder.as_uri()))
    file = Watched(b"".join(Archive(Objects(folder.as_uri()), "hd")))
    size = len(file.getvalue())

    def step(what: str, begun: float) -> None:
        read = sum(last - first for first, last in file.places)
        file.places.clear()
        print(f"{what}: {read} of {size} bytes, {time.perf_counter() - begun:.2f} s", flush=True)

    envmatte.open(file).weight.isel(x=0, y=0).compute()  # imports and compiles
    file.places.clear()
    with dask.config.set(scheduler="synchronous"):
        begun = time.perf_counter()
        glass = envmatte.open(file)
        step("open", begun)
        begun = time.perf_counter()
        glass[["u", "v", "weight"]].isel(x=WIDTH // 2, y=HEIGHT // 2).compute()
        step("lobes of a pixel", begun)


def _write(objects: Objects) -> None:
    """A matte of random values, each pixel of which sees a few cells."""
    columns, rows = 320, 180
    rng = np.random.default_rng(0)
    given = {"monitor": [WIDTH, HEIGHT], "crosstalk": np.eye(3).tolist()}
    options = {"method": "lobes", "rounds": 1, "resolution": 1.0, "quality": None}
    made = mattes.create(
        objects, "hd", height=HEIGHT, width=WIDTH, columns=columns, rows=rows, **given, options=options
    )
    most = Pyramid.over(columns, rows).nodes - CELLS
    for at in np.ndindex(made.block_rows, made.block_columns):
        shape = tuple(part.stop - part.start for part in made.span(*at))
        whole = np.ones(shape, bool)
        count = np.zeros((*shape, 3), np.uint32)
        count[..., 0] = CELLS
        first = rng.integers(0, most, (whole.size, 1))
        weight = rng.random((whole.size, CELLS)) + 0.1
        weight /= weight.sum(axis=1, keepdims=True)
        made.write(
            *at,
            Block(
                *rng.random((2, *shape, 3), np.float32),
                rng.random(shape, np.float32),
                whole,
                whole,
                count,
                (first + np.arange(CELLS)).astype(np.uint32).ravel(),
                weight.astype(np.float32).ravel(),
            ),
        )


if __name__ == "__main__":
    main()
