"""A real browser, and a real service for it."""

import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.end_to_end.conftest import Service, serving

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ARGUMENTS = [
    "--no-sandbox",  # tests may run as root; the pages are our own
    "--enable-unsafe-swiftshader",  # WebGL2 without a graphics card, and without a warning
    "--use-fake-device-for-media-stream",  # a camera that shows a moving picture
    "--use-fake-ui-for-media-stream",  # and that every page may use
]


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(tmp_path_factory.mktemp("service") / "data", "--workers", "1") as running:
        yield running


# A module's: as long as it lives it keeps an event loop in this thread, and no other test could run one.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("pages are tested in Chromium, which is not installed: apt-get install chromium")
    with sync_playwright() as playwright:
        yield (running := playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS))
        running.close()


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    """A page of its own, of 640 x 360 pixels; what it throws fails the test."""
    context = browser.new_context(
        viewport={"width": 640, "height": 360}, screen={"width": 640, "height": 360}
    )
    thrown: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: thrown.append(str(error)))
    yield page
    context.close()
    assert not thrown
