"""The stage of a matte: what its URL keeps, what it is compared with, and what is around the glass."""

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import PHONE, SIZE, is_fitting, unfold
from tests.browser.pages import opened as page_of
from tests.end_to_end.conftest import BANDS, Service
from tests.parts.captures import nested_program
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

pytestmark = pytest.mark.slow

CANVAS = "(canvas) => canvas.toDataURL('image/png')"
COPY = """(image) => {
	const canvas = document.createElement("canvas");
	[canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
	canvas.getContext("2d").drawImage(image, 0, 0);
	return canvas.toDataURL("image/png");
}"""


@pytest.fixture(scope="module")
def masked(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A matte whose mask leaves out what is around the object."""
    path = tmp_path_factory.mktemp("masked") / "ball.zip"
    write_capture(
        glass_ball.glass_ball(*SIZE, rays=9), nested_program(bands=BANDS, levels=5), path, mask=True
    )
    uploaded = service.client.upload(path)
    service.client.wait(uploaded["job"])
    return str(service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])["matte"])


def opened(page: Page, service: Service, matte: str, query: str = "") -> None:
    page.goto(f"{service.url}/#/mattes/{matte}{query}")
    expect(page.get_by_text("exact")).to_be_visible()
    unfold(page)


def pixels(page: Page, selector: str, script: str = CANVAS) -> NDArray[np.float64]:
    """What a canvas or, by ``COPY``, a picture shows, (rows, columns, 4)."""
    url = page.locator(selector).evaluate(script)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGBA"), float)


def test_reload_and_link_show_the_same(desk: Page, service: Service, masked: str) -> None:
    opened(desk, service, masked)
    expect(desk).to_have_url(re.compile(r"#/mattes/\w+$"))
    desk.get_by_role("radio", name="Stripes").check()
    desk.get_by_role("slider", name="Turn").fill("30")
    desk.get_by_label("Transparent around the glass").check()
    expect(desk).to_have_url(re.compile(r"\?angle=30&backdrop=Stripes&around=nothing$"))
    desk.reload()
    expect(desk.get_by_text("Stripes: exact")).to_be_visible()
    unfold(desk)
    expect(desk.get_by_role("radio", name="Stripes")).to_be_checked()
    expect(desk.locator("output[for=place-angle]")).to_have_text("30°")
    expect(desk.get_by_label("Transparent around the glass")).to_be_checked()


def test_view_that_was_chosen_meanwhile_stays_chosen(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1])
    # The picture becomes exact after the link was followed, and before the app hears of that.
    desk.locator(".stage").first.evaluate(
        "stage => { location.hash = '#/captures'; stage.dispatchEvent(new Event('exact', { bubbles: true })); }"
    )
    expect(desk).to_have_url(re.compile(r"#/captures$"))
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()


def test_picture_is_divided_between_backdrop_and_glass(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1], "?backdrop=Stripes&right=0.25")
    aside = desk.locator("canvas.aside")
    expect(aside).to_be_hidden()
    desk.get_by_role("radio", name="Backdrop").check()
    expect(aside).to_be_visible()
    bare = pixels(desk, "canvas.aside")
    np.testing.assert_array_equal(bare[:, :20, :3], 0)  # what is left of the backdrop is black
    assert np.unique(bare[0, 30:, :3], axis=0).shape[0] >= 6
    desk.get_by_role("slider", name="Divide").fill("20")
    expect(aside).to_have_css("clip-path", "inset(0px 80% 0px 0px)")
    box = desk.get_by_role("group", name="Composite.").bounding_box()
    assert box
    desk.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.3 * box["height"])
    desk.mouse.down()
    desk.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.4 * box["height"], steps=3)
    desk.mouse.up()
    expect(aside).to_have_css("clip-path", re.compile(r"^inset\(0px (29|30)\.?\d*% 0px 0px\)$"))
    expect(desk.locator("output[for=place-right]")).to_have_text("25 %")  # the backdrop stays
    before = aside.evaluate(CANVAS)
    desk.get_by_role("radio", name="Live").check()
    desk.wait_for_function("(before) => document.querySelector('.aside').toDataURL() !== before", arg=before)
    desk.get_by_role("slider", name="Turn").press("ArrowRight")
    expect(aside).to_be_hidden()  # until the picture is exact again
    expect(aside).to_be_visible()


def test_what_the_mask_left_out_shows_the_backdrop_or_nothing(
    desk: Page, service: Service, masked: str
) -> None:
    opened(desk, service, masked, "?backdrop=White")
    stage = desk.get_by_role("group", name="Composite.")
    canvas = ".picture.stage > canvas:not(.aside, .inset)"
    stage.press("ArrowRight")
    stage.press("ArrowLeft")
    expect(desk.get_by_text("White: exact")).to_be_visible()
    around = pixels(desk, canvas)
    assert (around[..., 3] == 255).all()
    np.testing.assert_allclose(around[0, 5, :3], 255, atol=2)
    desk.get_by_label("Transparent around the glass").check()
    expect(desk.get_by_text("White: exact")).to_be_visible()
    alone = pixels(desk, canvas)
    assert (alone[0, 5] == 0).all()
    assert 0.1 < np.mean(alone[..., 3] > 0) < 0.9


def test_object_that_was_cut_out_stands_in_the_backdrop(desk: Page, service: Service, tmp_path: Path) -> None:
    # The frame sees the room too.
    scene = glass_ball.glass_ball(*SIZE, monitor=(512, 384), rays=9, distance=8)
    write_capture(scene, preset("sketch", *scene.monitor), tmp_path / "ball.zip")
    job = service.client.recover(service.client.upload(tmp_path / "ball.zip"), quality="fast", cut_out=True)
    matte = str(service.client.wait(job["id"])["matte"])
    opened(desk, service, matte, "?backdrop=Dusk&right=0.1&scale=1.2")

    def aside(name: str) -> NDArray[np.float64]:
        desk.get_by_role("radio", name=name, exact=True).check()
        expect(desk.locator("canvas.aside")).to_be_visible()
        return pixels(desk, "canvas.aside")

    live, bare = aside("Live"), aside("Backdrop")
    exact = pixels(desk, ".picture.stage img", COPY)
    assert np.sqrt(np.mean((live - exact) ** 2)) < 8
    around = np.abs(exact - bare).max(axis=2) < 16  # what the service shows there, this browser does too
    assert around[:, :16].all()
    assert 0.05 < 1 - around.mean() < 0.5  # and the glass

    box = desk.get_by_role("group", name="Composite.").bounding_box()
    assert box
    desk.mouse.move(box["x"] + 20, box["y"] + 20)
    desk.mouse.down()
    desk.mouse.move(box["x"] + 20 + box["width"] / 4, box["y"] + 20, steps=4)  # the backdrop follows the hand
    desk.mouse.up()
    expect(desk.get_by_text("exact")).to_be_visible()
    moved = aside("Backdrop")
    assert np.sqrt(np.mean((moved[:, 24:] - bare[:, :-24]) ** 2)) < 4

    unfold(desk)
    for plate in (True, False):
        desk.get_by_label("for a plate of the frame").set_checked(plate)
        with desk.expect_download() as download:
            desk.get_by_role("button", name="nuke.nk").click()
        assert download.value.path().read_bytes() == service.client.layer(matte, "nuke.nk", plate=plate)


def test_without_a_mask_nothing_can_be_transparent(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1])
    expect(desk.get_by_label("Transparent around the glass")).to_be_hidden()
    expect(desk.get_by_text("all that is around the glass was recovered too")).to_be_visible()


@pytest.mark.parametrize(
    ("locale", "folds"),
    [
        ("en-GB", ("Placement", "Comparison", "Copy and download")),
        ("de-DE", ("Lage", "Vergleich", "Kopieren und herunterladen")),
    ],
)
def test_the_controls_folds_are_seen_on_a_small_laptop(
    browser: Browser, service: Service, masked: str, locale: str, folds: tuple[str, ...]
) -> None:
    with page_of(browser, locale=locale, viewport={"width": 1280, "height": 800}) as page:
        page.goto(f"{service.url}/#/mattes/{masked}")
        sheet = page.locator(".sheet")
        expect(sheet.get_by_text(re.compile(": ex"))).to_be_visible()
        shown = sheet.bounding_box()
        assert shown
        for fold in folds:
            box = sheet.get_by_text(fold, exact=True).bounding_box()
            assert box
            assert box["y"] + box["height"] <= shown["y"] + shown["height"] <= 800


def test_own_backdrop_stays_among_the_choices(
    desk: Page, service: Service, ready: tuple[str, str], tmp_path: Path
) -> None:
    opened(desk, service, ready[1])
    for name, colour in (("sea.png", "blue"), ("hill.png", "green")):
        path = tmp_path / name
        Image.new("RGB", (64, 48), colour).save(path)
        desk.get_by_label("Picture or clip").set_input_files(path)
        expect(desk.get_by_role("radio", name=name)).to_be_checked()
        expect(desk.get_by_text(f"{name}: exact")).to_be_visible()
        thumb = pixels(desk, ".thumb-choice:has(:checked) canvas")
        np.testing.assert_array_equal(thumb[36, 48, :3], Image.new("RGB", (1, 1), colour).getpixel((0, 0)))
    expect(desk.get_by_role("radio", name="sea.png")).to_have_count(0)  # the last one alone
    desk.get_by_role("radio", name="Stripes").check()
    expect(desk.get_by_text("Stripes: exact")).to_be_visible()
    desk.get_by_role("radio", name="hill.png").check()
    expect(desk.get_by_text("hill.png: exact")).to_be_visible()
    damaged = {"name": "sky.exr", "mimeType": "", "buffer": b"no picture"}
    desk.get_by_label("Picture or clip").set_input_files(damaged)
    expect(desk.get_by_role("alert")).to_be_in_viewport()
    expect(desk.locator(".thumb-choice:has(:checked)")).to_contain_text("exr")


def test_phone_has_the_controls_in_a_sheet_of_the_full_screen(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    desk.set_viewport_size(PHONE)
    desk.add_init_script("HTMLElement.prototype.requestFullscreen = undefined")  # as on many phones
    opened(desk, service, ready[1])
    desk.get_by_role("button", name="Full screen").click()
    controls = desk.get_by_text("Controls", exact=True)
    box = controls.bounding_box()
    assert box is not None
    assert box["y"] > 0.85 * PHONE["height"]  # folded, at the bottom
    stage = desk.get_by_role("group", name="Composite.").bounding_box()
    assert stage is not None
    assert stage["width"] == PHONE["width"]
    assert [one["id"] for one in Axe().run(desk).response["violations"]] == []
    controls.click()
    assert is_fitting(desk)
    controls.click()
    desk.get_by_role("button", name="Leave full screen").click()  # which does not need the controls
    expect(desk.get_by_role("list", name="Steps")).to_be_in_viewport()


def test_refused_picture_is_said_not_to_be_shown(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1])
    before = desk.locator(".picture.stage img").get_attribute("src")
    desk.get_by_label("Picture or clip").set_input_files(
        {"name": "beach.png", "mimeType": "image/png", "buffer": b"none"}
    )
    expect(desk.get_by_role("alert")).to_contain_text("The image can't be used")
    expect(desk.get_by_text("beach.png: not shown")).to_be_visible()
    assert desk.locator(".picture.stage img").get_attribute("src") == before


def test_picture_comes_back_by_itself_after_an_outage(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    for path in ("live", "composite?*"):
        desk.route(f"**/v1/mattes/*/{path}", lambda route: route.abort("connectionreset"))
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    expect(desk.get_by_role("alert")).to_contain_text("The service does not answer")
    expect(desk.get_by_text("not shown")).to_be_visible()
    for path in ("live", "composite?*"):
        desk.unroute(f"**/v1/mattes/*/{path}")
    expect(desk.get_by_text("exact")).to_be_visible()
    expect(desk.get_by_text("This browser draws the glass while you move")).to_be_visible()
    expect(desk.get_by_role("alert")).to_have_count(0)


def test_matte_that_cannot_be_compared_with_is_not_shown(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    other = {"id": "other", "state": "ready", "options": {"quality": "fine"}}
    desk.route("**/v1/mattes?capture=*", lambda route: route.fulfill(json={"mattes": [other]}))
    desk.route("**/v1/mattes/other/composite?*", lambda route: route.fulfill(status=500))
    opened(desk, service, ready[1])
    desk.get_by_role("radio", name="Backdrop").check()
    aside = desk.locator("canvas.aside")
    expect(aside).to_be_visible()
    desk.get_by_role("radio", name="Best").check()
    expect(desk.get_by_role("alert")).to_contain_text("The service answered with 500")
    expect(aside).to_be_hidden()


def test_backdrop_beside_an_explained_pixel_moves_along(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1])
    desk.get_by_role("button", name="Explain a pixel").click()
    expect(desk.locator("canvas.inset")).to_be_visible()
    before = pixels(desk, "canvas.inset")
    desk.get_by_role("slider", name="Turn").fill("30")
    assert np.abs(pixels(desk, "canvas.inset") - before).mean() > 5


def test_layer_that_does_not_come_is_not_mistaken_for_the_one_before(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    opened(desk, service, ready[1])
    picture = desk.locator(".layer img")
    expect(picture).to_be_visible()
    desk.route("**/layers/alpha.png", lambda route: route.fulfill(status=500))
    desk.get_by_role("radio", name="Mask").check()
    expect(desk.get_by_role("alert")).to_contain_text("The service answered with 500")
    expect(picture).to_be_hidden()
