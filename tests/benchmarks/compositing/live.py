"""Measures live pictures in the browser: agreement with the service's composites, and time per picture.

    python -m tests.benchmarks.compositing.live KIT SCENES [--renderer default] [--frames 60] [--no-ball] [--json FILE]

KIT is the path of a `kit.py` that makes captures of scenes, SCENES a folder of its scenes (`*.npz`). A real service
recovers each of them, and a traced glass ball of 640 x 480 pixels, from the program `quick` at the quality `fast`.
Chromium draws them before the kit's backdrops at several placements. For each scene it prints

- the PSNR of 8-bit sRGB pictures over the whole frame, the lowest of the placements;
- the milliseconds until the graphics card has drawn a picture, median and 95th percentile, for all pixels and for the
  smallest share of them that the app draws while a backdrop moves;
- the same in processor time, which depends less on other work on the machine;
- the megabytes that the browser loads, and the seconds that the service took to make them.

`--renderer` names one of ANGLE's.
"""

import base64
import io
import json
import shutil
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import numpy as np
import psutil
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from services.cli.demo_run import service
from services.client import Client
from tests.benchmarks.recovery.kits import load, parser_of, show
from workflows.images import integer_formats
from workflows.images.tone_curves import from_light
from workflows.programs.files import write_folder
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

PLACES = [
    {"right": 0, "down": 0, "scale": 1, "angle": 0},
    {"right": 0.13, "down": -0.07, "scale": 1, "angle": 0},
    {"right": 0, "down": 0.1, "scale": 1.7, "angle": 25},
    {"right": -0.1, "down": 0, "scale": 0.5, "angle": -70},
]
SOFTWARE = ("swiftshader", "llvmpipe", "software", "basic render")
BROWSER = "--no-sandbox", "--enable-unsafe-swiftshader"
OPEN = """async ([id, monitor]) => {
    const { webglContext, createPainter } = await import("/web/app/composite/live/webgl.js");
    const { decodeLive } = await import("/web/app/composite/live/live_form.js");
    const { Coarseness } = await import("/web/app/composite/live/coarseness.js");
    const found = decodeLive(await (await fetch(`/v1/mattes/${id}/live`)).arrayBuffer());
    const coarseness = new Coarseness(Math.min(found.width, found.height));
    const slow = Array.from({ length: 40 }, (_, n) => coarseness.next(1000 * n)); // a second for each picture
    const gl = webglContext(document.createElement("canvas"));
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    window.bench = { gl, painter: createPainter(gl, found, monitor) };
    return [gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER), slow.at(-1)];
}"""
DRAW = """async ([picture, places]) => {
    const bytes = Uint8Array.from(atob(picture), (one) => one.charCodeAt(0));
    bench.painter.setBackdrop(await createImageBitmap(new Blob([bytes]), { premultiplyAlpha: "none" }));
    return places.map((at) => {
        bench.painter.draw(at);
        return bench.gl.canvas.toDataURL("image/png").split(",")[1];
    });
}"""
TIME = """async ([frames, coarser]) => {
    const times = [];
    for (let n = 0; n < frames; n++) {
        const start = performance.now();
        bench.painter.draw({ right: 0.2 * Math.sin(n), down: 0.1, scale: 1, angle: n }, coarser);
        const drawn = bench.gl.fenceSync(bench.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
        bench.gl.flush();
        while (bench.gl.getSyncParameter(drawn, bench.gl.SYNC_STATUS) !== bench.gl.SIGNALED)
            await new Promise((resolve) => setTimeout(resolve, 1));
        times.push(performance.now() - start);
    }
    return times;
}"""


def decoded(data: bytes) -> NDArray[np.float64]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)


def graphics_seconds() -> float:
    """Processor time of the browser's graphics process, in seconds."""
    return sum(
        one.cpu_times().user + one.cpu_times().system
        for one in psutil.Process().children(recursive=True)
        if "--type=gpu-process" in one.cmdline()
    )


def measure(
    title: str, matte: str, backdrops: dict[str, bytes], http: httpx2.Client, page: Page, frames: int
) -> tuple[dict[str, Any], str]:
    """The row of a matte, and the renderer's name."""
    start = time.perf_counter()
    made = http.get(f"/v1/mattes/{matte}/live")
    seconds = time.perf_counter() - start
    found = http.get(f"/v1/mattes/{matte}").json()
    page.goto(str(http.base_url))
    renderer, coarsest = page.evaluate(OPEN, [matte, found["monitor"]])
    exact = {
        name: [
            decoded(http.post(f"/v1/mattes/{matte}/composite", params=at, content=picture).content)
            for at in PLACES
        ]
        for name, picture in backdrops.items()
    }
    row: dict[str, Any] = {"matte": title, "pixels": f"{found['width']} x {found['height']}"}
    for name, picture in backdrops.items():
        drawn = page.evaluate(DRAW, [base64.b64encode(picture).decode(), PLACES])
        errors = [
            np.mean((decoded(base64.b64decode(one)) - truth) ** 2)
            for one, truth in zip(drawn, exact[name], strict=True)
        ]
        row[f"{name}, dB"] = round(float(10 * np.log10(255**2 / max(errors))), 1)
    for coarser in range(coarsest + 1):
        of = f" of 1/{4**coarser}" if coarser else ""
        page.evaluate(TIME, [5, coarser])
        worked = graphics_seconds()
        times = page.evaluate(TIME, [frames, coarser])
        worked = graphics_seconds() - worked
        row |= {
            f"median ms{of}": round(float(np.median(times)), 1),
            f"p95 ms{of}": round(float(np.percentile(times, 95)), 1),
            f"CPU ms{of}": round(1e3 * worked / frames, 1),
        }
    row |= {
        "MB": round(int(made.headers["content-length"]) / 1e6, 2),
        "made in s": round(seconds, 1),
    }
    page.evaluate("bench.painter.close()")
    return row, renderer


def recover(kit: ModuleType, scenes: Path, ball: bool, client: Client, folder: Path) -> dict[str, str]:
    """The mattes, by their titles."""
    patterns = folder / "quick"
    write_folder(preset("quick"), patterns, lambda *_: None)
    archives = {}
    for scene in sorted(scenes.glob("*.npz")):
        archives[scene.stem] = folder / f"{scene.stem}.zip"
        with redirect_stdout(None):
            kit.main(["capture", str(scene), str(archives[scene.stem]), "--program", str(patterns)])
    if ball:
        archives["ball"] = folder / "ball.zip"
        write_capture(glass_ball.glass_ball(640, 480, rays=9), preset("quick"), archives["ball"])
    mattes = {}
    for title, capture_archive in archives.items():
        made = client.upload(capture_archive)
        client.wait(made["job"])
        mattes[title] = str(client.wait(client.recover(made["id"], quality="fast")["id"])["matte"])
    return mattes


def backdrops_of(kit: ModuleType) -> dict[str, bytes]:
    """The kit's backdrops as PNG, by their names."""
    return {
        name: integer_formats.encode_png(
            integer_formats.to_integers(from_light(np.clip(light, 0, 1), "srgb"), np.dtype(np.uint8))
        )
        for name, light in kit.backdrops().items()
    }


def compare(
    kit: ModuleType, url: str, mattes: dict[str, str], renderer: str, frames: int
) -> list[dict[str, Any]]:
    """Draw all mattes and print the results."""
    backdrops = backdrops_of(kit)
    arguments = [*BROWSER, *([f"--use-angle={renderer}"] if renderer != "default" else [])]
    rows: list[dict[str, Any]] = []
    with sync_playwright() as playwright, httpx2.Client(base_url=url, timeout=300) as http:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        page = browser.new_page()
        for title, matte in mattes.items():
            row, name = measure(title, matte, backdrops, http, page, frames)
            if not rows:
                software = any(word in name.lower() for word in SOFTWARE)
                print(f"renderer: {name}, {'software' if software else 'hardware'}", flush=True)
            show(row)
            rows.append(row | {"renderer": name, "software": software})
        browser.close()
    return rows


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--renderer", default="default", help="As Chromium's --use-angle takes it.")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--no-ball", dest="ball", action="store_false", help="Only the scenes.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    kit = load(args.kit)
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder, "data"), args.workers) as url,
        Client(url) as client,
    ):
        mattes = recover(kit, args.scenes, args.ball, client, Path(folder))
        rows = compare(kit, url, mattes, args.renderer, args.frames)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
