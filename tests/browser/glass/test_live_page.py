"""A matte saved as a web page: opened from a disk without a network, it draws the glass as the service does."""

import base64
import io
import json
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from services.api.mattes.live_page import PAGE, bundle
from tests.browser.pages import EXPECTED, PHONE, SIZE, is_fitting
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service, png
from workflows.simulation import glass_ball

pytestmark = pytest.mark.slow

DROP = """([name, type, data]) => {
    const files = new DataTransfer();
    files.items.add(new File([Uint8Array.from(atob(data), (one) => one.charCodeAt(0))], name, { type }));
    const drop = new DragEvent("drop", { dataTransfer: files, bubbles: true, cancelable: true });
    document.getElementById("stage").dispatchEvent(drop);
    return drop.defaultPrevented;
}"""


@pytest.fixture(scope="module")
def saved(service: Service, ready: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page as the command line writes it."""
    path = tmp_path_factory.mktemp("saved") / "glass.html"
    done = envmatte(service, "export", ready[1], "--html", "-o", str(path))
    assert (done.returncode, done.stdout.strip()) == (0, str(path)), done.stderr
    return path


@contextmanager
def offline(browser: Browser, path: Path, **options: object) -> Iterator[Page]:
    """A saved page, opened from the disk without a network; it must throw nothing, warn of nothing and load nothing."""
    context = browser.new_context(offline=True, **options)  # type: ignore[arg-type]
    wrong: list[str] = []
    requests: list[str] = []
    context.on("weberror", lambda thrown: wrong.append(str(thrown.error)))
    context.on(
        "console",
        lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    context.on("request", lambda request: requests.append(request.url))
    page = context.new_page()
    page.goto(path.as_uri())
    expect(page.locator("#choices")).to_be_visible()
    expect(page.locator("#status")).to_be_empty()
    yield page
    context.close()
    assert [text for text in wrong if not any(expected in text for expected in EXPECTED)] == []
    assert requests == [path.as_uri()]


@pytest.fixture
def glass(browser: Browser, saved: Path) -> Iterator[Page]:
    with offline(browser, saved, viewport={"width": 1000, "height": 700}) as page:
        yield page


def drawn(page: Page, since: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """What the page shows once nothing changes any more, (rows, columns, 3); another picture than ``since``."""
    last = None
    while True:
        page.wait_for_timeout(200)
        url = page.locator("canvas").evaluate("(canvas) => canvas.toDataURL('image/png')")
        data = base64.b64decode(url.partition(",")[2])
        before, last = last, np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)
        is_new = since is None or not np.array_equal(last, since)
        if is_new and before is not None and np.array_equal(last, before):
            return last


def psnr(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    assert one.shape == other.shape
    return float(10 * np.log10(255**2 / max(np.mean((one - other) ** 2), 1e-9)))


def composite(service: Service, matte: str, backdrop: bytes, **place: float) -> NDArray[np.float64]:
    answer = service.http.post(f"/v1/mattes/{matte}/composite", params=place, content=backdrop)
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), float)


def drop(page: Page, name: str, media_type: str, data: bytes) -> None:
    assert page.evaluate(DROP, [name, media_type, base64.b64encode(data).decode()])


def test_saved_page_draws_what_the_service_composites(
    glass: Page, service: Service, ready: tuple[str, str]
) -> None:
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    before = drawn(glass)
    drop(glass, "beach.png", "image/png", beach)
    expect(glass.locator("#choices input:checked")).to_have_count(0)
    found = drawn(glass, since=before)
    assert psnr(found, before) < 20  # another backdrop
    bare = Image.open(io.BytesIO(beach)).resize(SIZE)
    assert psnr(found, np.asarray(bare, float)) < 25  # and glass before it
    assert psnr(found, composite(service, ready[1], beach)) > 30


def test_drag_keys_and_wheel_move_the_backdrop(glass: Page, service: Service, ready: tuple[str, str]) -> None:
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    before = drawn(glass)
    drop(glass, "beach.png", "image/png", beach)
    at_rest = drawn(glass, since=before)
    box = glass.locator("#stage").bounding_box()
    assert box
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    glass.mouse.move(*middle)
    glass.mouse.down()
    glass.mouse.move(middle[0] + 0.2 * box["width"], middle[1], steps=5)
    glass.mouse.up()
    dragged = drawn(glass, since=at_rest)
    assert psnr(dragged, at_rest) < 25
    assert psnr(dragged, composite(service, ready[1], beach, right=0.2)) > 30
    glass.keyboard.press("]")  # the stage has the focus
    turned = drawn(glass, since=dragged)
    assert psnr(turned, composite(service, ready[1], beach, right=0.2, angle=2)) > 30
    glass.mouse.wheel(0, -500)
    enlarged = drawn(glass, since=turned)
    assert psnr(enlarged, turned) < 35
    glass.get_by_role("button", name="Reset").click()
    assert psnr(drawn(glass, since=enlarged), at_rest) > 60


@pytest.mark.exhaustive
def test_built_in_backdrops_differ(glass: Page) -> None:
    radios = glass.get_by_role("radio").all()
    assert len(radios) >= 3
    before = drawn(glass)
    for radio in radios[1:]:
        radio.check()
        after = drawn(glass, since=before)
        assert psnr(after, before) < 25
        before = after


def test_file_that_is_no_picture_is_explained(glass: Page) -> None:
    before = drawn(glass)
    drop(glass, "notes.txt", "text/plain", b"no picture")
    expect(glass.locator("#status")).to_have_text(
        "This browser cannot read notes.txt. Use PNG, JPEG or WebP."
    )
    assert psnr(drawn(glass), before) > 60


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_saved_page_is_accessible_and_fits_a_phone(browser: Browser, saved: Path, scheme: str) -> None:
    with offline(browser, saved, viewport=PHONE, color_scheme=scheme) as page:
        assert is_fitting(page)
        found = Axe().run(page).response["violations"]
        assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found] == []


def test_another_page_can_frame_it(browser: Browser, saved: Path, tmp_path: Path) -> None:
    (tmp_path / "glass.html").write_bytes(saved.read_bytes())
    (tmp_path / "index.html").write_text('<iframe src="glass.html" sandbox="allow-scripts"></iframe>')
    page = browser.new_page()
    page.goto((tmp_path / "index.html").as_uri())
    inner = page.frame_locator("iframe")
    expect(inner.locator("#choices")).to_be_visible()
    expect(inner.locator("#status")).to_be_empty()
    page.close()


def test_page_is_saved_by_a_button(desk: Page, service: Service, ready: tuple[str, str], saved: Path) -> None:
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    with desk.expect_download() as download:
        desk.get_by_role("button", name="Save as a web page").click()
    assert download.value.suggested_filename == "a_ball.html"
    assert download.value.path().read_bytes() == saved.read_bytes()
    answer = service.http.get(f"/v1/mattes/{ready[1]}/live.html")
    assert answer.headers["content-disposition"].startswith("attachment")
    assert service.http.get("/v1/mattes/nothing/live.html").status_code == 404


def test_name_that_looks_like_html_is_shown_as_text(
    browser: Browser, service: Service, ball: Path, tmp_path: Path
) -> None:
    name = '</title><script>window.ran = 1</script><img src=x onerror="window.ran = 1">'
    renamed = tmp_path / "renamed.zip"
    with zipfile.ZipFile(ball) as source, zipfile.ZipFile(renamed, "w") as target:
        for entry in source.namelist():
            content = source.read(entry)
            if entry == "capture.json":
                content = json.dumps(json.loads(content) | {"name": name}).encode()
            target.writestr(entry, content)
    uploaded = service.client.upload(renamed)
    job = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])
    page = tmp_path / "glass.html"
    page.write_bytes(service.client.live_page(str(job["matte"])))
    with offline(browser, page) as glass:
        expect(glass.get_by_role("heading")).to_have_text(name)
        expect(glass).to_have_title(name)
        assert glass.evaluate("window.ran") is None
    service.http.patch(f"/v1/mattes/{job['matte']}", json={"name": "a tumbler"})
    assert b"<title>a tumbler</title>" in service.client.live_page(str(job["matte"]))


def test_page_has_a_strict_policy_and_one_copy_of_each_module(saved: Path) -> None:
    text = saved.read_text()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)
    assert policy
    assert policy[1].startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy[1]
    script = bundle(PAGE / "page.js")
    assert text.count(script) == 1
    assert script.count("#version 300 es") == (PAGE.parent / "app/composite/live/webgl.js").read_text().count(
        "#version 300 es"
    )
    assert not re.search(r"^(import|export)\b|</script|<!--", script, re.MULTILINE)
