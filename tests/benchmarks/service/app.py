"""The web app's size, how long its views take in a browser from the click to the first paint, how long a newcomer
waits from `envmatte serve` for glass that moves, and how often it is drawn while its backdrop moves.

    python -m tests.benchmarks.service.app [--times 10]

Starts services on loopback and opens their views in a fresh Chromium, each time with an empty cache. Run it from the
root of the repository.
"""

import argparse
import gzip
import statistics
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from playwright.sync_api import Browser, Playwright, sync_playwright

from services.api.system.minified import TYPES, minified_file
from services.cli.demo_run import service
from tests.browser.conftest import ARGUMENTS, CHROMIUM

WEB = Path(__file__).parents[3] / "services" / "web"
VIEWS = ("", "captures", "jobs", "mattes", "film")
PAINT = """() => [
    performance.getEntriesByName("first-contentful-paint")[0].startTime,
    performance.getEntriesByType("navigation")[0].loadEventEnd,
    performance.getEntriesByType("resource").concat(performance.getEntriesByType("navigation"))
        .reduce((sum, one) => sum + one.transferSize, 0),
]"""

MOVES = """() => {
    const canvas = document.querySelector("canvas.glass");
    if (!canvas?.width || !canvas.isConnected) return false;
    const picture = canvas.toDataURL();
    const first = (window.first ??= picture);
    return picture !== first && document.querySelector("main").ariaBusy === "false";
}"""
"""Whether a second picture of the glass was drawn: by itself at first, as it greets who opens the app."""
KEEP_MOVING = """(seconds) => new Promise((resolve) => {
    const glass = document.querySelector(".glass-window");
    const painted = [];
    requestAnimationFrame(function next(now) {
        painted.push(now);
        if (now > painted[0] + 1000 * seconds) return resolve(painted);
        const key = now % 2000 < 1000 ? "ArrowRight" : "ArrowLeft";
        glass.dispatchEvent(new KeyboardEvent("keydown", { key }));
        requestAnimationFrame(next);
    });
})"""
"""Moves the backdrop with each picture; resolves with the times of all pictures."""


def _loaded_bytes(folder: Path, language: str) -> int:
    """Bytes of a folder's files as they are sent, compressed, with the words of one language."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    loaded = [path for path in files if "words" not in path.parts or path.stem == language]
    return sum(
        len(gzip.compress(minified_file(path, 0)[0], 6)) if path.suffix in TYPES else path.stat().st_size
        for path in loaded
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=10)
    times = parser.parse_args().times
    for folder in ("app", "samples"):
        for language in ("en", "de") if folder == "app" else ("any",):
            print(f"{folder}, language {language}: {_loaded_bytes(WEB / folder, language) / 1000:.0f} kB")
    print("`envmatte serve` listens after, s    glass moves after, s")
    for listens, moves in sorted(_start() for _ in range(3)):
        print(f"{listens:32.1f} {moves:23.1f}")
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder, "data"), 1) as url,
        sync_playwright() as playwright,
    ):
        between = _move(playwright, url)
        print("a sample of 640 x 480 pixels moves in software: ms between pictures, median and 95 %")
        print(" ".join(f"{one:.0f}" for one in between))
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        print("view        first paint, ms: median   max    loaded, ms: median    kB received")
        for view in VIEWS:
            found = [_open(browser, f"{url}/#/{view}") for _ in range(times)]
            paints, loads, sizes = zip(*found, strict=True)
            print(
                f"{view or 'home':10} {statistics.median(paints):24.0f} {max(paints):5.0f}"
                f" {statistics.median(loads):20.0f} {max(sizes) / 1000:15.0f}"
            )
        browser.close()


def _start() -> tuple[float, float]:
    """Seconds from the start of a service with an empty data folder until it listens, and until glass has moved."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page()
        start = time.perf_counter()
        with service(Path(folder, "data"), None) as url:
            listens = time.perf_counter() - start
            page.goto(url)
            while not page.evaluate(MOVES):
                page.wait_for_timeout(20)
            moves = time.perf_counter() - start
        browser.close()
    return listens, moves


def _move(playwright: Playwright, url: str) -> tuple[float, float]:
    """Milliseconds between two pictures of the first view while its backdrop moves, median and 95th percentile."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
    page = browser.new_page(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
    page.goto(url)
    page.locator("canvas.glass:visible").wait_for()
    page.evaluate(KEEP_MOVING, 1)  # the app finds how many pixels the device keeps up with
    painted = page.evaluate(KEEP_MOVING, 5)
    browser.close()
    between = sorted(after - before for before, after in pairwise(painted))
    return statistics.median(between), between[int(0.95 * len(between))]


def _open(browser: Browser, url: str) -> tuple[float, float, float]:
    """Milliseconds to the first paint and to the end of loading, and the bytes received."""
    context = browser.new_context()
    page = context.new_page()
    page.goto(url)
    page.locator("h1").wait_for()
    paint, load, size = page.evaluate(PAINT)
    context.close()
    return paint, load, size


if __name__ == "__main__":
    main()
