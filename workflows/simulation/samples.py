"""The samples that the web app opens with: objects traced, filmed with noise, recovered and encoded like any capture.

    python -m workflows.simulation.samples services/web/samples [NAME ...]

writes ``NAME.live`` (see `workflows.composite.live.encode`) and ``NAME.webp``, a still, for each of `SAMPLES` or for
those named, ``samples.json``, which describes all of them, and ``capture.zip``, a small capture to recover. It takes
a few minutes of a core for each. The same code on the same kind of processor writes the same bytes.
"""

import gzip
import io
import json
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.layout import uploads
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.composite import composite
from workflows.composite.live.encode import encode_live
from workflows.images.resample import area_mean
from workflows.images.tone_curves import from_light
from workflows.ingest.steps import STEPS as INGEST
from workflows.jobs import Steps, Task, run
from workflows.mattes.steps import STEPS as RECOVER
from workflows.programs.presets import preset
from workflows.simulation import objects as glass
from workflows.simulation.camera import Camera
from workflows.simulation.glass_ball import backdrop
from workflows.simulation.scene import Scene, write_capture
from workflows.simulation.solids import Solid
from workflows.simulation.tracer import trace
from workflows.threads import CORES
from workflows.untrusted.limits import Limits

SIZE = 640, 480
CAPTURE_SIZE = 160, 120
MONITOR = 1280, 960
RAYS = 16
OFFSET, GAIN = 0.004, 0.95
"""Of the camera: hardly any stray light, and white is not clipped."""
LIMITS = Limits(1 << 32, 1 << 28)
QUALITY = 90
"""Of JPEG and WebP."""
STEPS_OF_PLACES, STEPS_OF_LEVELS, STEPS_OF_SHARES = 16, 4, 3
"""What the codes of lookups are rounded to: a third of the monitor's pixel, a quarter of a level, an 85th of the light.
It makes the files a fifth smaller, and no eye sees it."""


@dataclass(frozen=True, eq=False)
class Sample:
    """An object to trace, and how to encode it.

    Attributes
    ----------
    title, about : str
        For people.
    solid : Solid
    index, absorption : float or three
        As in `trace`.
    lookups : int
        Lookups of a pixel: colours that part need more.
    """

    title: str
    about: str
    solid: Solid
    index: float | tuple[float, float, float] = 1.52
    absorption: float | tuple[float, float, float] = 0.0
    lookups: int = 2


SAMPLES = {
    "tumbler": Sample("Tumbler", "Clear, with a thick foot", glass.tumbler()),
    "stone": Sample(
        "Brilliant",
        "Tinted, and splits light into its colours",
        glass.stone(),
        (1.50, 1.52, 1.55),
        (0.45, 0.12, 0.04),
        3,
    ),
    "lens": Sample("Lens", "Magnifies what is behind it", glass.lens()),
}


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or SAMPLES:
        start = time.perf_counter()
        live, still = make(SAMPLES[name], SIZE)
        (folder / f"{name}.live").write_bytes(live)
        (folder / f"{name}.webp").write_bytes(still)
        seconds = time.perf_counter() - start
        print(f"{name}: {len(live)} bytes, a still of {len(still)}, {seconds:.0f} s", flush=True)
    (folder / "samples.json").write_text(json.dumps(describe(), indent=1) + "\n")
    (folder / "capture.zip").write_bytes(sample_capture())


def describe() -> list[dict[str, Any]]:
    """What the web app needs to know of each sample.

    Returns
    -------
    list of dict
        ``name``, ``title`` and ``about``; ``monitor``, its pixels; ``seen``, its size as the camera sees it, in frames.
    """
    seen = _camera(SIZE).seen
    return [
        {"name": name, "title": one.title, "about": one.about, "monitor": MONITOR, "seen": seen}
        for name, one in SAMPLES.items()
    ]


def make(sample: Sample, size: tuple[int, int]) -> tuple[bytes, bytes]:
    """Trace, film and recover a sample.

    Returns
    -------
    live : bytes
        For graphics hardware.
    still : bytes
        A WebP of it in front of a backdrop.
    """
    scene = film(sample, size)
    file = io.BytesIO()
    # With all pixels that the object touches: those at its edge see past it too, which makes the edge smooth.
    mask = scene.coverage > 0
    write_capture(scene, preset("default", *MONITOR), file, mask=mask, offset=OFFSET, gain=GAIN)
    with tempfile.TemporaryDirectory(prefix="envmatte-sample-") as folder:
        matte = recover(Objects(Path(folder).as_uri()), file.getvalue())
        return thin(encode_live(matte, CORES, sample.lookups)), _still(matte)


def film(sample: Sample, size: tuple[int, int]) -> Scene:
    """Trace a sample for a frame of a size."""
    return trace(
        sample.solid, _camera(size), index=sample.index, absorption=sample.absorption, room=glass.window
    )


def sample_capture() -> bytes:
    """A small capture archive, of frames as a camera would store them, to run a recovery on."""
    file = io.BytesIO()
    scene = film(SAMPLES["tumbler"], CAPTURE_SIZE)
    write_capture(
        scene,
        preset("sketch", *MONITOR),
        file,
        mask=scene.coverage > 0,
        name="sample tumbler",
        jpeg=QUALITY,
        offset=OFFSET,
        gain=GAIN,
        response="srgb",
    )
    return file.getvalue()


def recover(objects: Objects, archive: bytes) -> Matte:
    """Ingest a capture archive and recover its matte, as the service does."""
    objects.put(uploads.part_path("c", "all"), archive)
    uploads.seal(objects, "c", [uploads.Part("all", len(archive))])
    _run(INGEST, objects, Task("job", "c", "", {}, LIMITS))
    _run(RECOVER, objects, Task("job", "c", "m", {}, LIMITS))
    return Matte(objects, "m")


def thin(live: bytes) -> bytes:
    """Round what a matte for graphics hardware has of each lookup, so that it compresses better."""
    plain = gzip.decompress(live)
    start = 4 + int.from_bytes(plain[:4], "little")
    header = json.loads(plain[4:start])
    planes = (
        np.frombuffer(plain, np.uint8, offset=start).reshape(-1, header["height"], header["width"]).copy()
    )
    for k in range(header["lookups"]):
        lookup = planes[8 * k : 8 * k + 8]
        for axis in (lookup[:2], lookup[2:4]):
            places = np.cumsum(axis[0].astype(np.uint16) << 8 | axis[1], axis=1, dtype=np.uint16)
            steps = np.diff(_rounded(places, STEPS_OF_PLACES), axis=1, prepend=np.uint16(0))
            axis[0], axis[1] = steps >> 8, steps & 255
        lookup[4] = _rounded(lookup[4], STEPS_OF_LEVELS)
        lookup[5:] = _rounded(lookup[5:], STEPS_OF_SHARES)
    return gzip.compress(plain[:start] + planes.tobytes(), 9, mtime=0)


def _rounded(codes: NDArray[Any], step: int) -> NDArray[Any]:
    """Codes rounded to multiples of a step; the greatest code stays."""
    most = np.iinfo(codes.dtype).max
    nearest = (codes.astype(np.int64) + step // 2) // step * step
    rounded: NDArray[Any] = np.where(codes == most, most, np.minimum(nearest, most)).astype(codes.dtype)
    return rounded


def _camera(size: tuple[int, int]) -> Camera:
    return Camera(*size, MONITOR, RAYS)


def _run(steps: Steps, objects: Objects, task: Task) -> None:
    """Run all steps of a job, its tiles in as many processes as there are cores."""
    _, plan = run(steps, objects, task, PREPARE)
    task = replace(task, plan=plan)
    with ProcessPoolExecutor(CORES, get_context("spawn")) as processes:
        for done in [
            processes.submit(_tile, steps, objects.url, task, tile) for tile in range(plan["tiles"])
        ]:
            done.result()
    run(steps, objects, task, FINISH)


def _tile(steps: Steps, url: str, task: Task, tile: int) -> None:
    run(steps, Objects(url), task, tile)


def _still(matte: Matte) -> bytes:
    """A WebP of a matte before a backdrop, which is seen where the mask left pixels out."""
    wide, high = MONITOR
    light = np.ascontiguousarray(backdrop(3 * wide, 3 * high)[high:-high, wide:-wide])
    glass_light = composite(matte, light)
    width, height = matte.width, matte.height
    seen = np.array(_camera((width, height)).seen)
    across, down = ((np.array(MONITOR) * (1 - 1 / seen)) / 2).astype(int)
    bare = area_mean(
        np.ascontiguousarray(light[down : MONITOR[1] - down, across : MONITOR[0] - across]), width, height
    )
    alpha = glass_light[..., 3:]
    shown = from_light(np.clip(alpha * glass_light[..., :3] + (1 - alpha) * bare, 0, 1), "srgb")
    file = io.BytesIO()
    Image.fromarray(np.rint(255 * shown).astype(np.uint8)).save(file, "WEBP", quality=QUALITY, method=6)
    return file.getvalue()


if __name__ == "__main__":
    os.nice(5)
    main()
