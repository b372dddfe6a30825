"""`envmatte demo`: the whole way of a capture, from a glass ball to a composite, on this machine."""

import io
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from services.cli.progress import Progress
from services.client import Client
from workflows.images import integer_formats
from workflows.images.resample import area_mean
from workflows.images.tone_curves import from_light, to_light
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import Scene, write_capture
from workflows.untrusted.confinement import end_with_parent

WIDTH, HEIGHT = 240, 180
PANEL = 480, 360
ERROR_GAIN = 8


def run(
    workers: int | None, keep: Path | None = None, *, url: str | None = None, key: str | None = None
) -> tuple[bytes, dict[str, Any]]:
    """Trace, film, serve, upload, recover, composite.

    Parameters
    ----------
    workers : int, optional
        Worker processes; one a core if left out.
    keep : Path, optional
        Folder to leave the capture and the backdrop in, as `glass-ball.zip` and `backdrop.png`.
    url, key : str, optional
        A service that runs, to use in place of one of its own, and an API key of it.

    Returns
    -------
    picture : bytes
        A PNG: backdrop, composite, truth and error side by side.
    figures : dict
        ``psnr_db`` over the ball's pixels, in linear light, and the seconds that each step took.
    """
    times: dict[str, float] = {}

    @contextmanager
    def step(name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        times[f"{name}_seconds"] = round(time.perf_counter() - start, 1)

    with tempfile.TemporaryDirectory(prefix="envmatte-demo-") as folder, Progress("demo") as bar:
        with step("tracing"):
            bar.show(0, f"tracing a glass ball, {WIDTH} x {HEIGHT} pixels, 64 rays each")
            scene = glass_ball.glass_ball(WIDTH, HEIGHT, rays=64)
            capture = Path(folder, "glass-ball.zip")
            write_capture(scene, preset("default"), capture, name="glass ball")
        bar.show(0.1, "starting the service")
        start = time.perf_counter()
        serving = nullcontext(url) if url else service(Path(folder, "data"), workers)
        with serving as at, Client(at, key) as client:
            times["starting_seconds"] = round(time.perf_counter() - start, 1)
            with step("ingest"):
                bar.show(0.2, "uploading the capture")
                uploaded = client.upload(capture)
                client.wait(uploaded)
            with step("recovery"):
                job = client.wait(
                    client.recover(uploaded),
                    progress=lambda job: bar.show(0.25 + 0.7 * job.progress, f"recovery: {job.stage}"),
                )
            with step("composite"):
                backdrop = glass_ball.backdrop()
                encoded = integer_formats.encode_png(
                    integer_formats.to_integers(from_light(backdrop, "srgb"), np.dtype(np.uint16))
                )
                answer = client.composite(client.matte(job), encoded)
            bar.show(1, "done")
        if keep:
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(capture, keep)
            (keep / "backdrop.png").write_bytes(encoded)
    picture, psnr = _compare(scene, backdrop, answer)
    return picture, {"psnr_db": psnr, "object_pixels": int(scene.object_mask.sum()), **times}


def _compare(scene: Scene, backdrop: NDArray[np.float32], answer: bytes) -> tuple[bytes, float]:
    """A PNG of backdrop, composite, truth and error side by side, and the PSNR of the composite in linear light."""
    truth = np.clip(scene.truth(backdrop), 0, 1)
    composite = integer_formats.to_unit(integer_formats.decode(answer, memory=1 << 28))
    shown = from_light(truth, "srgb")
    error = np.mean((to_light(composite, "srgb") - truth)[scene.object_mask] ** 2)
    psnr = round(float(-10 * np.log10(error)), 2)
    panels = {
        "backdrop": from_light(area_mean(backdrop, *PANEL), "srgb"),
        f"composite, PSNR {psnr} dB": composite,
        "truth": shown,
        f"error x {ERROR_GAIN}": np.abs(composite - shown) * ERROR_GAIN,
    }
    return _side_by_side(panels), psnr


@contextmanager
def service(data: Path, workers: int | None) -> Iterator[str]:
    """A service of its own on a free port; yields its URL."""
    # -P: not sources in the folder that it is called from, whose kernels `envmatte warm` has not compiled.
    command = [sys.executable, "-P", "-m", "services", "serve", "--data", str(data), "--port", "0"]
    if workers:
        command += ["--workers", str(workers)]
    with (data.parent / "service.log").open("wb") as log:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            preexec_fn=partial(end_with_parent, signal.SIGTERM),
        )
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if " at http" not in line:
                raise RuntimeError(f"the service did not start: {(data.parent / 'service.log').read_text()}")
            yield line.rsplit(" at ", 1)[1].strip()
        finally:
            process.terminate()
            process.wait(30)


def _side_by_side(panels: dict[str, NDArray[np.float32]]) -> bytes:
    """A PNG of pictures, each with a caption under it."""
    gap, caption = 8, 28
    width = len(panels) * (PANEL[0] + gap) + gap
    sheet = Image.new("RGB", (width, PANEL[1] + 2 * gap + caption), "white")
    draw = ImageDraw.Draw(sheet)
    for n, (title, values) in enumerate(panels.items()):
        left = gap + n * (PANEL[0] + gap)
        pixels = integer_formats.to_integers(values, np.dtype(np.uint8))
        sheet.paste(Image.fromarray(pixels).resize(PANEL, Image.Resampling.NEAREST), (left, gap))
        draw.text((left, PANEL[1] + 2 * gap), title, "black", ImageFont.load_default(16))
    file = io.BytesIO()
    sheet.save(file, "PNG", optimize=True)
    return file.getvalue()
