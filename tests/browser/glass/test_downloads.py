"""What can be put behind the glass, and what can be taken along: files, the clipboard, a ZIP of several composites."""

import base64
import io
import re
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import SIZE, Held, opened, unfold, wait
from tests.end_to_end.conftest import Service, png
from workflows.images import float_formats
from workflows.simulation import glass_ball

pytestmark = pytest.mark.slow

EXACT = f"exact, {SIZE[0]} × {SIZE[1]} pixels"
BEACH = np.asarray(255 * np.clip(glass_ball.backdrop(320, 240), 0, 1), np.uint8)
COPIED = """async () => {
    const [item] = await navigator.clipboard.read();
    const bytes = new Uint8Array(await (await item.getType("image/png")).arrayBuffer());
    return btoa(bytes.reduce((text, byte) => text + String.fromCharCode(byte), ""));
}"""


def saved(kind: str, pixels: NDArray[np.uint8] = BEACH, **options: Any) -> bytes:
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, **options)
    return target.getvalue()


def pixels_of(data: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


@pytest.fixture
def stage(browser: Browser, service: Service, ready: tuple[str, str]) -> Iterator[Page]:
    """The page of a matte with its first composite."""
    with opened(
        browser, viewport={"width": 1200, "height": 800}, permissions=["clipboard-read", "clipboard-write"]
    ) as page:
        page.goto(f"{service.url}/#/mattes/{ready[1]}")
        expect(page.get_by_text(EXACT)).to_be_visible()
        unfold(page)
        yield page


def choose(page: Page, **files: bytes) -> None:
    page.get_by_label("Picture or clip").set_input_files(
        [
            {"name": name.replace("_", "."), "mimeType": "application/octet-stream", "buffer": data}
            for name, data in files.items()
        ]
    )


@pytest.mark.parametrize("kind", ["WEBP", "AVIF", "GIF"])
def test_web_formats_are_read_by_the_service_itself(stage: Page, kind: str) -> None:
    choose(stage, **{f"beach_{kind.lower()}": saved(kind)})
    # Without a word about a copy.
    expect(stage.get_by_text(f"beach.{kind.lower()}: {EXACT}", exact=True)).to_be_visible()


def test_picture_that_only_the_browser_reads_is_sent_as_a_copy(
    stage: Page, service: Service, ready: tuple[str, str]
) -> None:
    choose(stage, beach_bmp=saved("BMP"))
    note = "cannot read this file, so this browser sends a copy of 320 × 240 pixels."
    expect(stage.get_by_text(note)).to_be_visible()
    expect(stage.get_by_role("alert")).to_have_count(0)
    with stage.expect_download() as download:
        stage.get_by_role("button", name="PNG", exact=True).click()
    exact = service.http.post(
        f"/v1/mattes/{ready[1]}/composite?around=backdrop", content=saved("PNG")
    ).content
    np.testing.assert_array_equal(pixels_of(download.value.path().read_bytes()), pixels_of(exact))


def test_picture_over_the_limit_is_scaled_down_with_a_word_about_it(stage: Page) -> None:
    choose(stage, huge_png=saved("PNG", np.full((7000, 7000, 3), 200, np.uint8)))
    note = "does not take pictures this large, so this browser sends a copy of 2048 × 2048 pixels."
    expect(stage.get_by_text(note)).to_be_visible()
    expect(stage.get_by_role("alert")).to_have_count(0)


def test_file_that_nobody_reads_is_explained(stage: Page) -> None:
    choose(stage, notes_txt=b"no picture")
    expect(stage.get_by_role("alert")).to_contain_text(re.compile("This is not a PNG.*save it as PNG"))


def test_picture_is_copied(stage: Page, service: Service, ready: tuple[str, str]) -> None:
    body = png(glass_ball.backdrop(320, 240), "srgb", np.uint8)
    choose(stage, beach_png=body)
    expect(stage.get_by_text(f"beach.png: {EXACT}")).to_be_visible()
    stage.get_by_role("button", name="Copy picture").click()
    expect(stage.get_by_text("The picture is in the clipboard.")).to_be_visible()
    exact = service.http.post(f"/v1/mattes/{ready[1]}/composite?around=backdrop", content=body).content
    copied = base64.b64decode(stage.evaluate(COPIED))
    np.testing.assert_array_equal(pixels_of(copied), pixels_of(exact))


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "EXR"])
def test_picture_is_downloaded_at_twice_the_size(stage: Page, kind: str) -> None:
    stage.get_by_label("Twice the size").check()
    with stage.expect_download() as download:
        stage.get_by_role("button", name=kind, exact=True).click()
    content = download.value.path().read_bytes()
    if kind == "EXR":
        assert float_formats.decode(content, memory=1 << 24).shape[:2] == (2 * SIZE[1], 2 * SIZE[0])
        return
    with Image.open(io.BytesIO(content)) as picture:
        assert (picture.format, picture.size) == (kind, (2 * SIZE[0], 2 * SIZE[1]))


def test_several_pictures_come_back_as_a_zip(stage: Page, service: Service, ready: tuple[str, str]) -> None:
    bodies = {"beach.png": saved("PNG"), "night.webp": saved("WEBP", BEACH // 8, lossless=True)}
    with stage.expect_download() as download:
        choose(stage, beach_png=bodies["beach.png"], notes_txt=b"none", night_webp=bodies["night.webp"])
    assert download.value.suggested_filename == "composites.zip"
    with zipfile.ZipFile(download.value.path()) as archive:
        assert archive.namelist() == ["001-beach.png", "003-night.png"]
        for entry, body in zip(archive.namelist(), bodies.values(), strict=True):
            exact = service.http.post(
                f"/v1/mattes/{ready[1]}/composite?around=backdrop", content=body
            ).content
            assert archive.read(entry) == exact
    expect(stage.get_by_text("2 of 3 composites are in composites.zip.")).to_be_visible()
    expect(stage.get_by_role("alert")).to_contain_text("notes.txt: this is not a PNG")


def test_early_drag_is_drawn_as_soon_as_the_browser_can(
    browser: Browser, service: Service, ready: tuple[str, str]
) -> None:
    with opened(browser) as page:
        live = Held(page, "**/live")
        page.route("**/composite?*size=*", lambda route: None)  # the service never answers
        page.goto(f"{service.url}/#/mattes/{ready[1]}")
        page.get_by_role("group", name="Composite.").press("ArrowRight")
        expect(page.get_by_text("Checker: preview")).to_be_visible()
        page.wait_for_timeout(1000)
        held = Held(page, "**/composite?*")
        page.get_by_role("group", name="Composite.").press("ArrowRight")
        wait(page, lambda: held.routes)
        live.next().continue_()
        expect(page.get_by_text("Checker: live")).to_be_visible()
        expect(page.locator(".picture.stage canvas").first).to_be_visible()
        page.unroute("**/composite?*")
        held.release()
        expect(page.get_by_text(EXACT)).to_be_visible()
