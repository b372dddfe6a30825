"""The first view: a sample that is played with, without a capture, a matte or a key."""

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import BY_HAND, MINUTE, PHONE, Held, is_fitting, opened
from tests.browser.test_compositing import WITHOUT
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

SAMPLES = Path(__file__).parents[3] / "services" / "web" / "samples"
NAMES = [one["title"] for one in json.loads((SAMPLES / "samples.json").read_text())]
LIGHT = "(canvas) => canvas.toDataURL('image/png')"


def drawn(page: Page) -> NDArray[np.float64]:
    """The glass as it is drawn, (rows, columns, 4); transparent where the mask left pixels out."""
    url = page.locator("canvas.glass").evaluate(LIGHT)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGBA"), float)


def settled(page: Page, since: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """The glass once all of its pixels are drawn, and nothing moves any more; another one than ``since``."""
    last = np.zeros(0)

    def is_still() -> bool:
        nonlocal last
        before, last = last, drawn(page)
        return (
            last.shape == before.shape
            and min(last.shape[:2]) >= 480  # while much is drawn, it is coarser
            and bool(last.any())
            and bool(np.all(last == before))
            and (since is None or not np.array_equal(last, since))
        )

    until(is_still)
    return last


def test_first_view_is_a_glass_that_moves_under_the_hand(desk: Page, service: Service) -> None:
    asked: list[str] = []
    desk.on("request", lambda request: asked.append(request.url))
    desk.emulate_media(reduced_motion="reduce")
    desk.goto(service.url)
    expect(desk).to_have_url(re.compile("/#/$"))
    expect(desk.get_by_role("heading", name=NAMES[0])).to_be_visible()
    expect(desk.get_by_text("Sample: traced, not filmed")).to_be_visible()
    before = settled(desk)
    assert 0.1 < np.mean(before[..., 3] > 0) < 0.9
    glass = desk.get_by_role("group", name="Glass.")
    box = glass.bounding_box()
    assert box
    desk.mouse.move(box["x"] + 600, box["y"] + 200)
    desk.mouse.down()
    desk.mouse.move(box["x"] + 500, box["y"] + 260, steps=4)
    desk.mouse.up()
    moved = settled(desk, since=before)
    assert np.mean(np.abs(moved - before)[before[..., 3] > 0]) > 3
    glass.press("]")
    turned = settled(desk, since=moved)
    for name in ("Lights", "Tiles"):
        desk.get_by_role("radio", name=name).check(force=True)
        other = settled(desk, since=turned)
        assert np.mean(np.abs(other - turned)[before[..., 3] > 0]) > 3
        turned = other
    for name in NAMES[1:]:
        desk.get_by_role("radio", name=name).check(force=True)
        expect(desk.get_by_role("heading", name=name)).to_be_visible()
        other = settled(desk, since=turned)
        turned = other
    assert not any("/v1/" in url for url in asked)  # it takes neither a matte nor a key


def test_backdrop_around_the_glass_joins_what_is_seen_through_it(desk: Page, service: Service) -> None:
    # At its edge the object covers pixels in part: what they show is nearly what is beside it.
    desk.emulate_media(reduced_motion="reduce")
    desk.goto(service.url)
    glass = settled(desk)
    shot = np.asarray(Image.open(io.BytesIO(desk.screenshot())).convert("RGB"), float)
    box = desk.locator("canvas.glass").bounding_box()
    assert box
    rows, columns = glass.shape[:2]
    covered = glass[..., 3] > 0
    edge = covered & ~(
        np.roll(covered, 1, 0) & np.roll(covered, -1, 0) & np.roll(covered, 1, 1) & np.roll(covered, -1, 1)
    )
    y, x = np.nonzero(edge)
    out = np.array([x - x.mean(), y - y.mean()]) / np.hypot(x - x.mean(), y - y.mean())
    beside_x = np.rint(box["x"] + (x + 0.5 + 2 * out[0]) * box["width"] / columns).astype(int)
    beside_y = np.rint(box["y"] + (y + 0.5 + 2 * out[1]) * box["height"] / rows).astype(int)
    inside = (beside_x > 0) & (beside_x < shot.shape[1]) & (beside_y > 0) & (beside_y < 600)
    difference = glass[y, x, :3][inside] - shot[beside_y[inside], beside_x[inside]]
    assert np.median(np.abs(difference)) < 25


@pytest.mark.exhaustive  # as on the page of a matte, which a slow test covers
def test_camera_is_a_backdrop(desk: Page, service: Service) -> None:
    desk.goto(service.url)
    settled(desk)
    desk.get_by_role("radio", name="Use my camera").check(force=True)
    one = drawn(desk)
    until(lambda: not np.array_equal(drawn(desk), one))
    two = drawn(desk)
    until(lambda: not np.array_equal(drawn(desk), two))


@pytest.mark.slow
def test_own_picture_is_a_backdrop(desk: Page, service: Service, tmp_path: Path) -> None:
    Image.new("RGB", (64, 48), (0, 255, 0)).save(tmp_path / "green.png")
    (tmp_path / "empty.png").write_bytes(b"")
    desk.emulate_media(reduced_motion="reduce")
    desk.goto(service.url)
    before = settled(desk)
    own = desk.get_by_label("Your own picture")
    own.set_input_files(tmp_path / "empty.png")
    expect(desk.get_by_text("This browser cannot show the picture")).to_be_visible()
    expect(desk.get_by_role("radio", name="Dusk")).to_be_checked()
    own.set_input_files(tmp_path / "green.png")
    green = settled(desk, since=before)[before[..., 3] > 0].mean(axis=0)
    assert green[1] > 2 * max(green[0], green[2])
    expect(desk.get_by_role("radio", name="Dusk")).not_to_be_checked()
    desk.get_by_role("radio", name="Dusk").check(force=True)
    until(lambda: np.array_equal(drawn(desk), before))


@pytest.mark.slow
def test_picture_stands_in_while_the_glass_is_loading(desk: Page, service: Service) -> None:
    held = Held(desk, re.compile(r"\.live$"))
    desk.goto(service.url)
    still = desk.get_by_alt_text(f"{NAMES[0]} before a checkerboard")
    expect(still).to_be_visible()
    expect(desk.get_by_text("Loading", exact=True)).to_be_visible()
    held.release()
    expect(still).to_be_hidden()
    expect(desk.get_by_text("Loading", exact=True)).to_be_hidden()
    assert settled(desk).any()


@pytest.mark.slow
def test_sample_that_does_not_come_is_explained_until_another_does(desk: Page, service: Service) -> None:
    desk.goto(service.url)
    expect(desk.get_by_role("heading", name=NAMES[0])).to_be_visible()
    desk.route("**/*.live", lambda route: route.abort("connectionreset"))
    desk.get_by_role("radio", name=NAMES[1]).check()
    expect(desk.get_by_role("alert")).to_contain_text("The service does not answer")
    desk.unroute("**/*.live")
    desk.get_by_role("radio", name=NAMES[2]).check()
    expect(desk.get_by_role("alert")).to_have_count(0)


@pytest.mark.slow
def test_samples_are_removed_and_restored(desk: Page, service: Service) -> None:
    desk.goto(service.url)
    desk.get_by_role("button", name="Remove the samples").click()
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
    desk.goto("about:blank")
    desk.goto(service.url)
    expect(desk).to_have_url(re.compile("/#/captures$"))
    desk.get_by_role("link", name="envmatte").click()
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
    desk.get_by_role("button", name="Show the samples again").click()
    expect(desk.get_by_role("heading", name=NAMES[0])).to_be_visible()
    desk.get_by_role("link", name="Film your own").click()
    expect(desk.get_by_role("heading", name="Choose a program")).to_be_visible()
    desk.get_by_role("link", name="envmatte").click()
    expect(desk.get_by_role("heading", name=NAMES[0])).to_be_visible()


def test_without_webgl_a_still_is_shown(browser: Browser, service: Service) -> None:
    with opened(browser) as page:
        page.add_init_script(WITHOUT)
        page.goto(service.url)
        expect(page.get_by_text("This browser has no WebGL2")).to_be_visible()
        image = page.get_by_alt_text(f"{NAMES[0]} before a checkerboard")
        expect(image).to_be_visible()
        until(lambda: bool(image.evaluate("(image) => image.complete && image.naturalWidth >= 240")))
        page.get_by_role("radio", name=NAMES[-1]).check(force=True)
        expect(page.get_by_alt_text(f"{NAMES[-1]} before a checkerboard")).to_be_visible()


@pytest.mark.slow
@pytest.mark.parametrize("recovered", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_sample_capture_is_uploaded_and_read(desk: Page, service: Service, recovered: bool) -> None:
    desk.add_init_script(BY_HAND)
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_role("button", name="Try it with a sample capture").click()
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    capture = desk.url.rpartition("/")[2]
    service.client.wait(service.client.capture(capture)["job"])
    expect(desk.get_by_role("region", name="Report")).to_be_visible(timeout=MINUTE)
    report = service.http.get(f"/v1/captures/{capture}/report").json()
    assert report["level"] != "bad", report
    if recovered:
        matte = service.client.wait(service.client.recover(capture, quality="fast")["id"])["matte"]
        assert service.client.matte(matte)["state"] == "ready"


@pytest.mark.parametrize(
    ("device", "scheme"),
    [
        ("phone", "dark"),
        pytest.param("desk", "light", marks=pytest.mark.slow),
        pytest.param("phone", "light", marks=pytest.mark.exhaustive),
        pytest.param("desk", "dark", marks=pytest.mark.exhaustive),
    ],
)
def test_first_view_is_accessible_and_fits(
    browser: Browser, service: Service, device: str, scheme: str
) -> None:
    size = {"viewport": PHONE, "has_touch": True, "is_mobile": True} if device == "phone" else {}
    with opened(browser, color_scheme=scheme, reduced_motion="reduce", **size) as page:
        page.goto(service.url)
        settled(page)
        assert is_fitting(page)
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
        assert [one["id"] for one in Axe().run(page).response["violations"]] == []


@pytest.mark.parametrize("language", ["en-GB", "de-DE"])
def test_choices_of_the_first_view_stand_in_rows(browser: Browser, service: Service, language: str) -> None:
    with opened(browser, locale=language) as page:
        page.goto(service.url)
        choices = page.locator(".controls fieldset.thumbs")
        expect(choices).to_have_count(2)
        for width in (700, 1100, 1278, 1280, 1440):
            page.set_viewport_size({"width": width, "height": 800})
            for row in (*choices.all(), page.locator(".actions")):
                places = row.locator("label.thumb-choice, a").all()
                boxes = [box for one in places if (box := one.bounding_box())]
                assert len({box["y"] for box in boxes}) == 1, width
            assert boxes[0]["height"] < 45, width  # a line of the button to film


def test_shipped_samples_are_small() -> None:
    files = list(SAMPLES.iterdir())
    assert {file.suffix for file in files} == {".json", ".live", ".webp", ".zip"}
    assert max(file.stat().st_size for file in files) <= 1 << 20
