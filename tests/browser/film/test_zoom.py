"""Zoomed pages: where patterns would be resampled, the player says so before it shows any."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

from tests.browser.conftest import ARGUMENTS, CHROMIUM
from tests.browser.pages import phase_of, wait
from tests.end_to_end.conftest import Service

pytestmark = pytest.mark.slow

SCREEN = {"width": 640, "height": 360}
COUNTED = {"width": 800, "height": 450}
"""The screen as a page counts it that is zoomed to 125 %."""


@pytest.fixture
def zoomed(tmp_path: Path) -> Iterator[Page]:
    """A page on a screen of 640 x 360 pixels, in a browser whose zoom is 125 %."""
    if CHROMIUM is None:
        pytest.skip("pages are zoomed in Chromium, which is not installed: apt-get install chromium")
    preferences = tmp_path / "Default" / "Preferences"
    preferences.parent.mkdir()
    # Chromium counts its zoom in steps of 20 %.
    preferences.write_text(json.dumps({"partition": {"default_zoom_level": {"x": math.log(1.25, 1.2)}}}))
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path,
            executable_path=CHROMIUM,
            args=ARGUMENTS,
            viewport={"width": 640, "height": 360},
            screen={"width": 640, "height": 360},
        )
        thrown: list[str] = []
        context.on("weberror", lambda error: thrown.append(str(error.error)))
        page = context.pages[0]
        page.goto("about:blank")
        assert page.evaluate("[devicePixelRatio, innerWidth, screen.width]") == [1.25, 512, 640]
        yield page
        context.close()
        assert not thrown


def made(service: Service, monitor: dict[str, int]) -> str:
    """Make a program for a monitor; returns its id."""
    answer = service.http.post("/v1/programs", json={"preset": "sketch", "monitor": monitor, "border": True})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def load(page: Page, service: Service, program: str) -> None:
    page.goto(f"{service.url}/v1/programs/{program}/play")
    expect(page.get_by_role("status")).to_have_text("Ready.")


def set_zoom(page: Page, zoom: float) -> None:
    """Give an open page the sizes that it has at a zoom of the browser."""
    page.context.new_cdp_session(page).send(
        "Emulation.setDeviceMetricsOverride",
        {
            "width": int(640 / zoom),
            "height": int(360 / zoom),
            "screenWidth": 640,
            "screenHeight": 360,
            "deviceScaleFactor": zoom,
            "mobile": False,
        },
    )
    page.wait_for_function("(zoom) => devicePixelRatio === zoom", arg=zoom)


def test_program_that_a_zoomed_page_would_resample_is_not_started(zoomed: Page, service: Service) -> None:
    program = made(service, COUNTED)
    load(zoomed, service, program)
    note = zoomed.locator("#misfit")
    start = zoomed.get_by_role("button", name="full screen")
    stage = zoomed.locator("#stage")
    expect(note).to_be_hidden()  # the page counts 800 x 450 pixels until it is full screen
    start.click()
    expect(zoomed.get_by_role("status")).to_contain_text("Not started: the patterns do not fit.")
    expect(note).to_contain_text("This page is zoomed to 125 %. Set the zoom to 100 % (Ctrl+0")
    expect(note).to_contain_text("made for a screen of 800 × 450 pixels; this screen has 640 × 360")
    expect(stage).to_be_hidden()
    wait(zoomed, lambda: phase_of(service, program) == "stopped")
    start.click()  # the note has been shown: a second start plays
    expect(stage).to_be_visible()
    zoomed.keyboard.press("Escape")
    with zoomed.expect_navigation():
        zoomed.get_by_role("button", name="Fit it to this screen").click()
    expect(zoomed.get_by_role("status")).to_have_text("Ready.")
    expect(zoomed.get_by_text("patterns of 604 × 324 pixels")).to_be_visible()
    expect(note).to_be_hidden()
    start.click()
    expect(stage).to_be_visible()


def test_program_that_fits_is_played_at_any_zoom(zoomed: Page, service: Service) -> None:
    load(zoomed, service, made(service, SCREEN))
    note = zoomed.locator("#misfit")
    expect(note).to_contain_text("seems to be zoomed to 125 %. Set the zoom to 100 % (Ctrl+0")
    zoomed.get_by_role("button", name="full screen").click()
    canvas = zoomed.locator("#canvas")
    expect(canvas).to_have_js_property("width", 640)
    expect(canvas).to_have_js_property("height", 360)
    zoomed.keyboard.press("Escape")
    expect(zoomed.get_by_role("status")).to_have_text("Stopped.")
    expect(note).to_be_hidden()


def test_sizes_follow_the_zoom(tab: Page, service: Service) -> None:
    set_zoom(tab, 1.25)
    load(tab, service, made(service, SCREEN))
    note = tab.locator("#misfit")
    expect(note).to_contain_text("seems to be zoomed to 125 %")
    set_zoom(tab, 1)
    expect(note).to_be_hidden()
    tab.goto(f"{service.url}/#/film")
    width = tab.get_by_label("The monitor’s width")
    expect(width).to_have_value("640")
    set_zoom(tab, 1.25)
    expect(width).to_have_value("800")
