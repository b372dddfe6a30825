"""The web app's size, and how long its views take in a browser from the click to the first paint.

    python -m tests.benchmarks.service.app [--times 10]

Starts a service on loopback and opens its views in a fresh Chromium, each time with an empty cache. Run it from the
root of the repository.
"""

import argparse
import statistics
import tempfile
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from services.cli.demo_run import service
from tests.browser.conftest import CHROMIUM

WEB = Path(__file__).parents[3] / "services" / "web"
VIEWS = ("captures", "jobs", "mattes", "film")
PAINT = """() => [
    performance.getEntriesByName("first-contentful-paint")[0].startTime,
    performance.getEntriesByType("navigation")[0].loadEventEnd,
    performance.getEntriesByType("resource").concat(performance.getEntriesByType("navigation"))
        .reduce((sum, one) => sum + one.transferSize, 0),
]"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=10)
    times = parser.parse_args().times
    files = [path for path in WEB.rglob("*") if path.is_file()]
    print(f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1000:.0f} kB")
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder, "data"), 1) as url,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        print("view        first paint, ms: median   max    loaded, ms: median    kB received")
        for view in VIEWS:
            found = [_open(browser, f"{url}/#/{view}") for _ in range(times)]
            paints, loads, sizes = zip(*found, strict=True)
            print(
                f"{view:10} {statistics.median(paints):24.0f} {max(paints):5.0f} {statistics.median(loads):20.0f}"
                f" {max(sizes) / 1000:15.0f}"
            )
        browser.close()


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
