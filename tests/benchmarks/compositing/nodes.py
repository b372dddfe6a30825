"""The nodes of Blender beside the service's composites: the table and the picture of the README of the nodes.

    python -m tests.benchmarks.compositing.nodes blender.png

recovers a ball, a lens and a tumbler, prints the PSNR of each before every backdrop, against the service and against
the formula of the EXR, and writes a picture. It needs Blender, see `test_blender.py`.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import backdrops, draw, psnr, recovered
from tests.workflows.composite.live.nodes.test_blender import render, render_material, write_nodes
from workflows.composite import composite
from workflows.composite.live.nodes.exr import LOOKUPS
from workflows.images.tone_curves import from_light

SHOWN = "photo", "strokes"
GREY = 0.25
"""Light where the mask left pixels out."""


def main() -> None:
    rows = [_measure(name) for name in ("ball", "lens", "tumbler")]
    picture = Image.fromarray(np.rint(255 * np.concatenate(rows)).astype(np.uint8))
    larger = picture.resize((picture.width * 3 // 2, picture.height * 3 // 2), Image.Resampling.NEAREST)
    larger.save(sys.argv[1], optimize=True)


def _measure(name: str) -> NDArray[np.floating]:
    """Print the rows of a glass, and return its row of the picture."""
    tiles = []
    with tempfile.TemporaryDirectory(prefix="envmatte-nodes-") as folder:
        matte = recovered(Objects(Path(folder, "store").as_uri()), name)
        entries = matte.layer("count").sum(axis=-1)[matte.layer("recovered")]
        print(f"{name}: entries of a pixel, median and 90th percentile: {np.percentile(entries, (50, 90))}")
        write_nodes(matte, Path(folder), LOOKUPS)
        of_service, of_formula, of_material = {}, {}, {}
        for kind, backdrop in backdrops().items():
            seen, service = render(Path(folder), backdrop), composite(matte, backdrop)
            glass = service[..., 3] > 0
            of_service[kind] = round(psnr(seen, service, glass), 1)
            of_formula[kind] = round(psnr(seen, draw(Path(folder, "lookups.exr"), backdrop), glass), 1)
            material = render_material(Path(folder), (matte.width, matte.height), backdrop)
            of_material[kind] = round(psnr(material, service, glass), 1)
            if kind in SHOWN:
                tiles += [*map(_shown, (seen, service)), _difference(seen, service)]
        print(f"{name} against the service: {of_service}")
        print(f"{name} against the formula: {of_formula}")
        print(f"{name}, the material against the service: {of_material}", flush=True)
    return np.concatenate(
        [np.pad(tile, ((2, 2), (2, 2), (0, 0)), constant_values=1) for tile in tiles], axis=1
    )


def _shown(picture: NDArray[np.float32]) -> NDArray[np.floating]:
    """A picture (height, width, 4) in front of grey, in sRGB."""
    alpha = picture[..., 3:]
    return from_light(np.clip(alpha * picture[..., :3] + (1 - alpha) * GREY, 0, 1), "srgb")


def _difference(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.floating]:
    """Five times the difference of two pictures, around grey."""
    return np.clip(0.5 + 5 * other[..., 3:] * (one - other)[..., :3], 0, 1)


if __name__ == "__main__":
    main()
