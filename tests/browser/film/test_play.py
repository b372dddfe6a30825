"""The page that plays a program, in a real browser: its border is that of `workflows.programs.border`."""

import base64
import io
import json
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.pages import phase_of, wait
from tests.end_to_end.conftest import Service, serving
from tests.parts.waiting import until
from workflows.programs.border import (
    LEAD,
    MAX_NUMBERED,
    Border,
    draw_border,
    number_cells,
    read_numbers,
    schedule,
    tick_cells,
)
from workflows.programs.files import pictures
from workflows.programs.program import Program

pytestmark = pytest.mark.slow

SCREEN = {"width": 640, "height": 360}
SHORT = {
    "monitor": SCREEN,
    "parts": [
        {"kind": "constant", "levels": [0, 1]},
        {"kind": "bernoulli", "columns": 8, "rows": 6, "count": 2, "seed": 1, "colour": "grey"},
    ],
}
DISPLAYS = [(640, 360), (1920, 1080), (1080, 1920), (3440, 1440), (161, 121), (90, 60), (200, 5000)]
NUMBERS = [LEAD, 0, 1, 62, 63, 64, 1023, MAX_NUMBERED - 1]


def posted(service: Service, **changes: Any) -> dict[str, Any]:
    answer = service.http.post(
        "/v1/programs", json={"preset": "sketch", "monitor": SCREEN, "border": True} | changes
    )
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def go(tab: Page, service: Service, program: dict[str, Any]) -> str:
    url = f"{service.url}/v1/programs/{program['id']}/play"
    tab.goto(url)
    expect(tab.get_by_role("status")).to_have_text("Ready.", timeout=60_000)
    return url


def drawn(tab: Page, program: dict[str, Any], number: int, white: bool) -> NDArray[np.uint8]:
    """A frame as the page draws it, (360, 640, 3)."""
    url = tab.evaluate(
        """async ([number, white]) => {
            const page = await import(new URL("/web/play/border.js", location.href));
            const canvas = Object.assign(document.createElement("canvas"), { width: 640, height: 360 });
            const blob = number < 0 ? null : await (await fetch(`patterns/${number}.png`)).blob();
            const picture = blob && (await createImageBitmap(blob, { colorSpaceConversion: "none" }));
            page.draw(canvas.getContext("2d", { alpha: false }), page.borderOn(640, 360), { number, white }, picture);
            return canvas.toDataURL("image/png");
        }""",
        [number, white],
    )
    image = Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2])))
    return np.asarray(image.convert("RGB"))


def test_page_looks_like_the_app(tab: Page, service: Service) -> None:
    def look(name: str) -> list[str]:
        button = tab.get_by_role("button", name=name)
        return [
            button.evaluate("(button, style) => getComputedStyle(button)[style]", style)
            for style in ("backgroundColor", "borderRadius", "fontFamily", "minHeight")
        ]

    go(tab, service, posted(service))
    played = look("full screen")
    expect(tab.get_by_role("link", name="envmatte")).to_be_visible()
    tab.goto(f"{service.url}/#/film")
    assert look("Continue") == played


def test_page_has_the_rules_of_the_border(tab: Page, service: Service) -> None:
    go(tab, service, posted(service))
    rules = tab.evaluate(
        """async ([displays, numbers]) => {
            const page = await import(new URL("/web/play/border.js", location.href));
            return {
                borders: displays.map(([width, height]) => page.borderOn(width, height)),
                codes: numbers.map(page.code),
                ticks: numbers.map(page.tick),
                schedule: page.schedule(7, 4),
            };
        }""",
        [DISPLAYS, NUMBERS],
    )
    for (width, height), found in zip(DISPLAYS, rules["borders"], strict=True):
        try:
            border = Border(width=width, height=height)
        except ValueError:
            assert not found["fits"]
            continue
        assert found["fits"]
        for name in ("inner", "top", "bottom", "left", "right"):
            assert np.array_equal(found[name], getattr(border, name))
    assert np.array_equal(rules["codes"], [number_cells(number) for number in NUMBERS])
    assert np.array_equal(rules["ticks"], [tick_cells(number) for number in NUMBERS])
    expected = [(step.seconds, step.number, step.white) for step in schedule(7, 4)]
    assert [(step["seconds"], step["number"], step["white"]) for step in rules["schedule"]] == expected


def test_page_draws_the_border(tab: Page, service: Service) -> None:
    program = posted(service)
    go(tab, service, program)
    shown = Program.model_validate(program["program"])
    border = Border(**SCREEN)
    for white in (False, True):
        level = np.full((1, 1, 3), 255 * white, np.uint8)
        np.testing.assert_array_equal(drawn(tab, program, -1, white), draw_border(level, -1, border))
    every = list(pictures(shown))
    for number in (0, 6, 20, 31):
        picture = np.broadcast_to(every[number], (*every[number].shape[:2], 3))
        np.testing.assert_array_equal(
            drawn(tab, program, number, False), draw_border(picture, number, border)
        )


def test_every_pattern_is_shown_in_order_for_its_time(tab: Page, service: Service) -> None:
    program = posted(service)
    go(tab, service, program)
    # Samples the canvas at every frame of the display, in a loop of its own.
    tab.evaluate(
        """(boxes) => {
            window.seen = [];
            window.played = new Promise((resolve) => document.addEventListener("played", (e) => resolve(e.detail)));
            const canvas = document.getElementById("canvas");
            const look = (now) => {
                if (canvas.width === 640) {
                    const y = Math.floor(boxes[0][3] / 2);
                    const row = canvas.getContext("2d").getImageData(0, y, 640, 1).data;
                    const middle = canvas.getContext("2d").getImageData(320, 180, 1, 1).data[0];
                    window.seen.push([now, middle, boxes.map(([x, , w]) => row[4 * Math.floor(x + w / 2)])]);
                }
                requestAnimationFrame(look);
            };
            requestAnimationFrame(look);
        }""",
        Border(**SCREEN).top,
    )
    tab.get_by_label("Patterns a second").fill("10")
    tab.get_by_role("button", name="full screen").press("Enter")
    played = tab.evaluate("window.played")
    seen = tab.evaluate("window.seen")
    refresh = played["refresh"]
    steps = schedule(37, 10)
    assert [(s["number"], s["white"]) for s in played["shown"]] == [(s.number, s.white) for s in steps]

    # The pattern numbers as the reader of the border sees them, and black and white of the lead-in.
    numbers, certain = read_numbers(np.array([cells for *_, cells in seen], float))
    at = np.array([now for now, *_ in seen])
    states = [
        (int(number), middle > 127 if number == LEAD else None)
        for number, (_, middle, _), sure in zip(numbers, seen, certain, strict=True)
        if sure
    ]
    times = at[certain]
    expected = [(s.number, s.white if s.number == LEAD else None) for s in steps]
    runs = [(state, [i for i, _ in group]) for state, group in groupby(enumerate(states), key=lambda e: e[1])]
    assert [state for state, _ in runs] == expected
    # Each step lasts its number of refreshes, to within one; frames that this machine missed are accounted for.
    lost = np.concatenate([[0], np.cumsum(np.rint(np.diff(times) / refresh) - 1)])
    before = 0
    for (_, now), (_, after), step in zip(runs[:-1], runs[1:], steps, strict=False):
        first, last = now[0], after[0]
        refreshes = (times[last] - times[first]) / refresh
        missed = lost[last] - lost[before]
        off = refreshes - step.seconds * 1000 / refresh
        assert off < 1.5 + missed, step
        assert off > -1.5 - missed or step is steps[0], step  # the first may be seen late
        before = first
    expect(tab.get_by_role("status")).to_contain_text("All 37 patterns were shown")
    link = tab.get_by_role("link", name="capture.json")
    expect(link).to_be_visible()
    with tab.expect_download() as download:
        link.click()
    manifest = json.loads(download.value.path().read_text())
    assert manifest["video"]["border"] == SCREEN
    first, last = (times[next(i for i, (state, _) in enumerate(states) if state == n)] for n in (0, 36))
    assert manifest["video"]["patterns_per_second"] == pytest.approx(36 / (last - first) * 1000, rel=0.1)
    assert manifest["program"] == program["program"]


def test_pictures_are_shown_one_by_one_for_stills(tab: Page, service: Service) -> None:
    asked = {"program": SHORT, "monitor": SCREEN, "border": True}
    program = service.http.post("/v1/programs", json=asked).json()
    go(tab, service, program)
    tab.get_by_role("button", name="Show for stills").press("Enter")
    border = Border(**SCREEN)
    every = [np.zeros((SCREEN["height"], SCREEN["width"], 3), np.uint8) for _ in range(4)]
    x, y, width, height = border.inner
    for screen, picture in zip(every, pictures(Program.model_validate(program["program"])), strict=True):
        screen[y : y + height, x : x + width] = picture
    presses = (None, 0), ("Space", 1), ("ArrowLeft", 0), ("PageDown", 1), ("x", 1), ("click", 2), ("Enter", 3)
    for press, number in presses:
        if press == "click":
            tab.mouse.click(320, 180)
        elif press:
            tab.keyboard.press(press)
        until(lambda number=number: np.array_equal(canvas(tab), every[number]))
    assert phase_of(service, program["id"]) is None
    tab.keyboard.press("ArrowRight")
    expect(tab.get_by_role("status")).to_contain_text("All 4 pictures were shown")
    expect(tab.get_by_role("button", name="Show for stills")).to_be_focused()


def canvas(tab: Page) -> NDArray[np.uint8]:
    """What the page shows, (height, width, 3)."""
    url = tab.evaluate("document.getElementById('canvas').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"))


def test_escape_stops_and_program_can_be_played_again(tab: Page, service: Service) -> None:
    go(tab, service, posted(service))
    start = tab.get_by_role("button", name="full screen")
    for _ in range(2):
        start.click()
        expect(tab.locator("#stage")).to_be_visible()
        expect(tab.locator("#countdown")).to_have_text("4")
        tab.keyboard.press("Escape")
        expect(tab.locator("#stage")).to_be_hidden()
        expect(tab.get_by_role("status")).to_have_text("Stopped.")
        expect(start).to_be_focused()


def test_back_button_stops_and_keeps_loaded_patterns(tab: Page, service: Service) -> None:
    program = posted(service)
    tab.goto(f"{service.url}/#/captures")
    url = go(tab, service, program)
    start = tab.get_by_role("button", name="full screen")
    for _ in range(2):
        start.click()
        expect(tab.locator("#stage")).to_be_visible()
        tab.go_back()
        expect(tab.locator("#stage")).to_be_hidden()
        expect(tab.get_by_role("status")).to_have_text("Stopped.")
        assert tab.url == url
        expect(start).to_be_enabled()
    tab.go_back()
    expect(tab.get_by_role("heading", name="Captures")).to_be_visible()


def test_leaving_the_page_stops_the_program(tab: Page, service: Service) -> None:
    program = posted(service)
    go(tab, service, program)
    with tab.expect_request("**/showing") as report:
        tab.get_by_role("button", name="full screen").click()
    expect(tab.locator("#countdown")).to_have_text("4")
    tab.goto(f"{service.url}/#/captures")
    wait(tab, lambda: phase_of(service, program["id"]) == "stopped")
    countdown = report.value.post_data_json
    assert countdown["phase"] == "countdown"
    late = service.http.put(f"/v1/programs/{program['id']}/showing", json=countdown)
    assert late.status_code == 204
    assert phase_of(service, program["id"]) == "stopped"


def test_program_of_another_size_is_fitted_to_this_screen(tab: Page, service: Service) -> None:
    first = go(tab, service, posted(service, monitor={"width": 800, "height": 600}))
    expect(
        tab.get_by_text("made for a screen of 800 × 600 pixels; this screen has 640 × 360")
    ).to_be_visible()
    with tab.expect_navigation():
        tab.get_by_role("button", name="Fit it to this screen").click()
    expect(tab.get_by_role("status")).to_have_text("Ready.")
    assert tab.url != first
    expect(tab.get_by_text("37 patterns of 604 × 324 pixels")).to_be_visible()
    expect(tab.locator("#fit")).to_be_hidden()


def test_page_asks_for_a_key_where_needed(tab: Page, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("locked") / "data"
    with serving(folder, "--workers", "1", ENVMATTE_KEYS="secret") as locked:
        locked.http.headers["Authorization"] = "Bearer secret"
        program = posted(locked)
        tab.goto(f"{locked.url}/v1/programs/{program['id']}/play")
        key = tab.get_by_label("Key of the service")
        for text, status in (
            ("wrong", "not know the key"),
            ("ключ", "not know the key"),
            ("secret", "Ready."),
        ):
            expect(key).to_be_visible()
            key.fill(text)
            key.press("Enter")
            expect(tab.get_by_role("status")).to_contain_text(status)
        expect(key).to_be_hidden()


def test_pictures_that_do_not_come_at_first_or_at_all(tab: Page, service: Service) -> None:
    program = posted(service)
    pictures = "**/patterns/7.png"
    tab.route(pictures, lambda route: route.abort("connectionreset"), times=1)
    go(tab, service, program)
    for answer, words in (
        (lambda route: route.abort("connectionreset"), "The service does not answer. Check that it runs"),
        (lambda route: route.fulfill(status=502, body="<html>"), "The service answered with 502."),
    ):
        tab.route(pictures, answer)
        tab.reload()
        expect(tab.get_by_role("status")).to_contain_text(words)
        tab.unroute(pictures)


def test_aiming_shows_white_in_the_border_until_a_camera_sees_it(tab: Page, service: Service) -> None:
    program = posted(service)
    go(tab, service, program)

    def aim() -> None:
        tab.get_by_role("button", name="Aim the camera").click()
        tab.wait_for_function("() => document.getElementById('canvas').width === 640")

    aim()
    url = tab.evaluate("document.getElementById('canvas').toDataURL('image/png')")
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"))
    white = np.full((1, 1, 3), 255, np.uint8)
    np.testing.assert_array_equal(shown, draw_border(white, LEAD, Border(**SCREEN)))
    tab.keyboard.press("Escape")
    expect(tab.get_by_role("status")).to_have_text("Stopped.")
    aim()
    begun = {"phase": "countdown", "patterns_per_second": 2, "seconds": 8}
    assert service.http.put(f"/v1/programs/{program['id']}/showing", json=begun).status_code == 204
    until(lambda: phase_of(service, program["id"]) == "showing")
    tab.keyboard.press("Escape")
    until(lambda: phase_of(service, program["id"]) == "stopped")
    aim()  # what was reported before starts nothing
    tab.keyboard.press("Space")
    until(lambda: phase_of(service, program["id"]) == "countdown")
    tab.keyboard.press("Escape")
