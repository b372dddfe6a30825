"""Compositing in a real browser: the live pictures that it draws agree with the composites of the service."""

import base64
import io
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.browser.pages import PHONE, Held, unfold
from tests.end_to_end.conftest import BANDS, Service, png
from tests.parts.captures import nested_program
from tests.parts.waiting import until
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

pytestmark = pytest.mark.slow

SIZE = 96, 72
MINUTE = 60_000
READY = "This browser draws the glass while you move"
EXACT = re.compile(rf"exact, {SIZE[0]} × {SIZE[1]} pixels")
COUNTED = """
    const made = (window.made = { Texture: 0, Program: 0, Framebuffer: 0, VertexArray: 0, Shader: 0, Sync: 0 });
    const type = WebGL2RenderingContext.prototype;
    for (const kind in made) {
        for (const [name, by] of [[kind === "Sync" ? "fenceSync" : `create${kind}`, 1], [`delete${kind}`, -1]]) {
            const real = type[name];
            type[name] = function (...args) { made[kind] += by; return real.apply(this, args); };
        }
    }"""
WITHOUT = """
    const real = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, ...args) {
        return kind === "webgl2" ? null : real.call(this, kind, ...args);
    };"""
COARSER = """async ([id, picture, monitor]) => {
    const { webglContext, createPainter } = await import("/web/app/composite/live/webgl.js");
    const { decodeLive } = await import("/web/app/composite/live/live_form.js");
    const found = decodeLive(await (await fetch(`/v1/mattes/${id}/live`)).arrayBuffer());
    const gl = webglContext(document.createElement("canvas"));
    const painter = createPainter(gl, found, monitor);
    const bytes = Uint8Array.from(atob(picture), (one) => one.charCodeAt(0));
    painter.setBackdrop(await createImageBitmap(new Blob([bytes]), { premultiplyAlpha: "none" }));
    return [0, 1, 2].map((coarser) => {
        painter.draw({ right: 0.1, down: 0, scale: 1, angle: 0 }, coarser);
        return gl.canvas.toDataURL("image/png");
    });
}"""
COPY = """async (picture) => {
    const bytes = Uint8Array.from(atob(picture), (one) => one.charCodeAt(0));
    await navigator.clipboard.write([new ClipboardItem({ "image/png": new Blob([bytes], { type: "image/png" }) })]);
}"""
LEVELS = """async (shorter) => {
    const { Coarseness } = await import("/web/app/composite/live/coarseness.js");
    const coarseness = new Coarseness(shorter);
    return Array.from({ length: 12 }, (_, n) => coarseness.next(60 * n));
}"""
KEPT = """
    const real = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);
    navigator.mediaDevices.getUserMedia = async (constraints) => (window.stream = await real(constraints));"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory, service: Service) -> str:
    path = tmp_path_factory.mktemp("ball") / "ball.zip"
    write_capture(glass_ball.glass_ball(*SIZE, rays=9), nested_program(bands=BANDS, levels=5), path)
    uploaded = service.client.upload(path)
    service.client.wait(uploaded["job"])
    return str(service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])["matte"])


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    context = browser.new_context(viewport={"width": 1200, "height": 800}, accept_downloads=True)
    yield context
    context.close()


def opened(context: BrowserContext, service: Service, matte: str) -> Page:
    """The page of a matte with its first composite; fails the test if it throws."""
    page = context.new_page()
    page.on("pageerror", lambda error: pytest.fail(str(error)))
    page.goto(f"{service.url}/#/mattes/{matte}")
    expect(page.get_by_text(EXACT)).to_be_visible(timeout=MINUTE)
    unfold(page)
    return page


def pixels(data: bytes) -> NDArray[np.float64]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)


def drawn(page: Page) -> NDArray[np.float64]:
    """What the browser has drawn last, (rows, columns, 3)."""
    url = page.locator(".picture.stage canvas").first.evaluate("(canvas) => canvas.toDataURL('image/png')")
    return of_url(url)


def of_url(url: str) -> NDArray[np.float64]:
    return pixels(base64.b64decode(url.partition(",")[2]))


def choose(page: Page, data: bytes, name: str, kind: str) -> None:
    page.get_by_label("Picture or clip").set_input_files({"name": name, "mimeType": kind, "buffer": data})


def filmed(path: Path, frames: int) -> bytes:
    """A clip whose picture moves to the side."""
    still = np.asarray(glass_ball.backdrop(160, 120) * 255, np.uint8)
    with av.open(path, "w") as file:
        stream = file.add_stream("libx264", 10)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for n in range(frames):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.roll(still, 8 * n, axis=1), "rgb24")))
        file.mux(stream.encode(None))
    return path.read_bytes()


def test_live_picture_agrees_with_service(context: BrowserContext, service: Service, ball: str) -> None:
    page = opened(context, service, ball)
    expect(page.get_by_text(READY)).to_be_visible(timeout=MINUTE)
    requests: list[str] = []
    page.on("request", lambda one: requests.append(one.url) if "/composite?" in one.url else None)
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    choose(page, beach, "beach.png", "image/png")
    expect(page.get_by_text(re.compile("beach.png: exact"))).to_be_visible(timeout=MINUTE)
    for turned in ({}, {"Move right": "0.15"}, {"Move down": "-0.3", "Turn": "30"}, {"Size": "-0.3"}):
        for name, value in turned.items():
            page.get_by_role("slider", name=name).fill(value)
        expect(page.get_by_text(EXACT)).to_be_visible(timeout=MINUTE)
        place = {name: value for name, (value,) in parse_qs(urlsplit(requests[-1]).query).items()}
        del place["quality"]
        exact = service.http.post(f"/v1/mattes/{ball}/composite", params=place, content=beach)
        error = np.mean((drawn(page) - pixels(exact.content)) ** 2)
        assert 10 * np.log10(255**2 / error) > 30, place
    assert not any("size=" in url for url in requests)


def test_coarser_live_pictures_agree_with_service(
    context: BrowserContext, service: Service, ball: str
) -> None:
    page = opened(context, service, ball)
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    monitor = service.http.get(f"/v1/mattes/{ball}").json()["monitor"]
    sent = base64.b64encode(beach).decode()
    exact = pixels(
        service.http.post(
            f"/v1/mattes/{ball}/composite", params={"right": 0.1, "down": 0}, content=beach
        ).content
    )
    for coarser, one in enumerate(page.evaluate(COARSER, [ball, sent, monitor])):
        every = 2**coarser
        found, expected = of_url(one), exact[every // 2 :: every, every // 2 :: every]
        assert found.shape == expected.shape
        assert 10 * np.log10(255**2 / np.mean((found - expected) ** 2)) > (30, 26, 22)[coarser]


def test_slow_device_draws_fewer_pixels_but_240(context: BrowserContext, service: Service) -> None:
    page = context.new_page()
    page.goto(service.url)
    assert page.evaluate(LEVELS, 1000) == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]  # 250 pixels are left
    assert page.evaluate(LEVELS, 959) == [0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]


def test_live_picture_is_replaced_by_exact_one(context: BrowserContext, service: Service, ball: str) -> None:
    page = opened(context, service, ball)
    expect(page.get_by_text(READY)).to_be_visible(timeout=MINUTE)
    held = Held(page, "**/composite?*")
    canvas, image = page.locator(".picture.stage canvas").first, page.locator(".picture.stage img")
    page.get_by_role("group", name="Composite.").press("ArrowRight")
    expect(page.get_by_text("Checker: live")).to_be_visible()
    expect(canvas).to_be_visible()
    expect(image).to_be_hidden()
    page.wait_for_timeout(500)
    held.release()
    page.unroute("**/composite?*")
    expect(page.get_by_text(EXACT)).to_be_visible(timeout=MINUTE)
    expect(image).to_be_visible()
    expect(canvas).to_be_hidden()


def test_camera_is_a_backdrop_and_released_when_leaving(
    context: BrowserContext, service: Service, ball: str
) -> None:
    context.add_init_script(KEPT)
    page = opened(context, service, ball)
    expect(page.get_by_text(READY)).to_be_visible(timeout=MINUTE)
    page.get_by_role("radio", name="Camera").check()
    expect(page.get_by_text("Camera: live")).to_be_visible(timeout=MINUTE)
    before = drawn(page)
    until(lambda: np.abs(drawn(page) - before).max() > 10)
    page.get_by_role("button", name="Pause").click()
    expect(page.get_by_text(re.compile("Camera: exact"))).to_be_visible(timeout=MINUTE)
    page.get_by_role("button", name="Play").click()
    expect(page.get_by_text("Camera: live")).to_be_visible()
    page.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    until(lambda: page.evaluate("stream.getTracks().every((track) => track.readyState === 'ended')"))


def test_missing_camera_is_explained(context: BrowserContext, service: Service, ball: str) -> None:
    context.add_init_script("Object.defineProperty(navigator, 'mediaDevices', { value: undefined })")
    page = opened(context, service, ball)
    page.get_by_role("radio", name="Camera").click()
    expect(page.get_by_role("alert")).to_contain_text("Open this page at https")
    expect(page.get_by_role("radio", name="Checker")).to_be_checked()  # which is still shown


def test_clip_is_composited_and_downloaded(
    context: BrowserContext, service: Service, ball: str, tmp_path: Path
) -> None:
    page = opened(context, service, ball)
    expect(page.get_by_text(READY)).to_be_visible(timeout=MINUTE)
    page.get_by_role("slider", name="Turn").fill("10")
    choose(page, filmed(tmp_path / "clip.mp4", 12), "clip.mp4", "video/mp4")
    expect(page.get_by_text("clip.mp4: live")).to_be_visible(timeout=MINUTE)
    page.get_by_role("button", name="Make the video").click()
    save = page.get_by_role("button", name="Download the video")
    expect(save).to_be_visible(timeout=MINUTE)
    with page.expect_download() as download:
        save.click()
    assert download.value.suggested_filename == "composite.mp4"
    with av.open(download.value.path()) as file:
        made = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(made) == 12
    assert made[0].shape == (SIZE[1], SIZE[0], 3)
    job = page.get_by_role("link", name="Show the job").get_attribute("href")
    assert job
    options = service.http.get(f"/v1/jobs/{job.rpartition('/')[2]}").json()["options"]
    assert options["placement"]["angle"] == 10
    assert (options["around"], options["fit"]) == ("backdrop", "frame")


def test_pasted_picture_becomes_backdrop(context: BrowserContext, service: Service, ball: str) -> None:
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    page = opened(context, service, ball)
    before = page.locator(".picture.stage img").get_attribute("src")
    page.evaluate(COPY, base64.b64encode(png(glass_ball.backdrop(64, 48), "srgb", np.uint8)).decode())
    page.keyboard.press("Control+V")
    expect(page.get_by_text(re.compile(r"image\.png: exact"))).to_be_visible(timeout=MINUTE)
    expect(page.get_by_role("radio", name="Checker")).not_to_be_checked()
    expect(page.locator(".picture.stage img")).not_to_have_attribute("src", before or "")


def test_two_fingers_move_scale_and_turn(browser: Browser, service: Service, ball: str) -> None:
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True)
    page = opened(context, service, ball)
    stage = page.get_by_role("group", name="Composite.")
    stage.scroll_into_view_if_needed()
    box = stage.bounding_box()
    assert box
    touch = context.new_cdp_session(page)

    def fingers(kind: str, points: dict[int, tuple[float, float]]) -> None:
        """Sends a touch event. Points are in widths of the picture from its centre, by finger."""
        at = [
            {
                "id": n,
                "x": box["x"] + (0.5 + right) * box["width"],
                "y": box["y"] + 0.5 * box["height"] + down * box["width"],
            }
            for n, (right, down) in points.items()
        ]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    fingers("touchStart", {0: (-0.1, 0)})
    fingers("touchStart", {0: (-0.1, 0), 1: (0.1, 0)})
    fingers("touchMove", {0: (0, -0.2), 1: (0, 0.2)})  # twice as far apart, and a quarter clockwise
    fingers("touchMove", {0: (0.1, -0.2), 1: (0.1, 0.2)})
    fingers("touchEnd", {1: (0.1, 0.2)})
    fingers("touchMove", {0: (0.2, -0.2)})
    fingers("touchEnd", {0: (0.2, -0.2)})
    for name, expected in (("right", "20 %"), ("down", "0 %"), ("scale", "200 %"), ("angle", "90°")):
        expect(page.locator(f"output[for=place-{name}]")).to_have_text(expected)
    context.close()


def test_clip_that_browser_cannot_play_is_explained(
    context: BrowserContext, service: Service, ball: str
) -> None:
    page = opened(context, service, ball)
    choose(page, b"no clip", "clip.mp4", "video/mp4")
    expect(page.get_by_role("alert")).to_contain_text("cannot play the clip")
    page.get_by_role("button", name="Make the video").click()
    stage = page.get_by_role("region", name="Compositing")
    expect(stage.get_by_text("failed", exact=True)).to_be_visible(timeout=MINUTE)


def test_without_webgl_the_service_draws(context: BrowserContext, service: Service, ball: str) -> None:
    context.add_init_script(WITHOUT)
    requests: list[str] = []
    page = opened(context, service, ball)
    expect(page.get_by_text("no WebGL2")).to_be_visible()
    page.on("request", lambda one: requests.append(one.url))
    page.get_by_role("group", name="Composite.").press("ArrowRight")
    expect(page.get_by_text(EXACT)).to_be_visible(timeout=MINUTE)
    assert f"size={SIZE[0]}" in next(url for url in requests if "/composite?" in url)
    page.get_by_role("radio", name="Camera").check()
    expect(page.get_by_text("Camera: preview")).to_be_visible(timeout=MINUTE)
    until(lambda: page.evaluate("document.querySelector('.stage img').naturalWidth === 96"))
    assert not any(url.endswith("/live") for url in requests)


def test_leaving_frees_the_graphics_card(context: BrowserContext, service: Service, ball: str) -> None:
    context.add_init_script(COUNTED)
    page = opened(context, service, ball)
    expect(page.get_by_text(READY)).to_be_visible(timeout=MINUTE)
    assert page.evaluate("made.Texture") >= 5
    page.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    expect(page.get_by_role("heading", name="Mattes")).to_be_visible()
    until(lambda: page.evaluate("Object.values(made).every((count) => count === 0)"))


@pytest.mark.parametrize(("kind", "magic"), [("PNG", b"\x89PNG"), ("JPEG", b"\xff\xd8"), ("EXR", b"v/1\x01")])
def test_composite_is_downloaded(
    context: BrowserContext, service: Service, ball: str, kind: str, magic: bytes
) -> None:
    page = opened(context, service, ball)
    with page.expect_download() as download:
        page.get_by_role("button", name=kind, exact=True).click()
    name = service.client.matte(ball)["name"]
    assert download.value.suggested_filename == f"{name.replace(' ', '_')}.{kind.lower()}"
    assert download.value.path().read_bytes().startswith(magic)
