"""A real browser, and a real service for it."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.browser.pages import MINUTE, SIZE, opened
from tests.end_to_end.conftest import BANDS, Service, serving
from tests.parts.captures import nested_program
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WINDOWLESS = shutil.which("chromium-headless-shell") or CHROMIUM
"""Chromium without windows if it is there, in which a page takes a third of the processor time."""
ARGUMENTS = [
    "--no-sandbox",  # tests may run as root; the pages are our own
    "--enable-unsafe-swiftshader",  # WebGL2 without a graphics card, and without a warning
    "--use-fake-device-for-media-stream",  # a camera that shows a moving picture
    "--use-fake-ui-for-media-stream",  # which every page may use
]

expect.set_options(timeout=MINUTE)  # a busy machine may take longer than the usual five seconds


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--scenes",
        nargs=2,
        metavar=("KIT", "SCENES"),
        help="A kit that films scenes, and a folder of scenes, as the benchmarks take them.",
    )


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(tmp_path_factory.mktemp("service") / "data", "--workers", "1") as running:
        yield running


# Of a module: it keeps an event loop in this thread while it lives, so no other test could run one.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if WINDOWLESS is None:
        pytest.skip("pages are tested in Chromium, which is not installed: apt-get install chromium")
    with sync_playwright() as playwright:
        yield (running := playwright.chromium.launch(executable_path=WINDOWLESS, args=ARGUMENTS))
        running.close()


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ball") / "ball.zip"
    write_capture(
        glass_ball.glass_ball(*SIZE, rays=9), nested_program(bands=BANDS, levels=5), path, name="a ball"
    )
    return path


@pytest.fixture(scope="session")
def ready(service: Service, ball: Path) -> tuple[str, str]:
    """A capture and its matte, both ready."""
    uploaded = service.client.upload(ball)
    service.client.wait(uploaded["job"])
    recovered = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])
    return uploaded["id"], str(recovered["matte"])


@pytest.fixture
def desk(browser: Browser) -> Iterator[Page]:
    """A page of 1200 x 800 pixels that fails the test if anything goes wrong in it, see `opened`."""
    with opened(browser, viewport={"width": 1200, "height": 800}) as page:
        yield page


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    """A page of 640 x 360 pixels that fails the test if it throws."""
    context = browser.new_context(
        viewport={"width": 640, "height": 360}, screen={"width": 640, "height": 360}
    )
    thrown: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: thrown.append(str(error)))
    yield page
    context.close()
    assert not thrown
