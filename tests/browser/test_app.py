"""The web app in a real browser, from a ZIP to a composite, and what goes wrong on the way."""

import base64
import io
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from tests.end_to_end.conftest import BANDS, Service, paused, serving
from workflows import images, simulate
from workflows.scene import nested_program, write_capture

pytestmark = pytest.mark.full

SIZE = 96, 72
PHONE = {"width": 390, "height": 844}
MINUTE = 60_000
APP = Path(__file__).parents[2] / "services" / "web" / "app"
UNNAMED = """() => [...document.querySelectorAll("input, select, button, progress, a, [tabindex='0']")]
    .filter((e) => !(e.labels?.length || e.ariaLabel || e.textContent.trim()))
    .concat(...document.querySelectorAll("img:not([alt])"))
    .map((e) => e.outerHTML)"""
SAID = (
    "the server responded with a status of 4",
    "net::ERR_CONNECTION_RESET",
    "GPU stall due to ReadPixels",
)
"""What the browser itself says of an answer that is a problem, of a line that breaks, and of WebGL without a graphics
card."""


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ball") / "ball.zip"
    write_capture(
        simulate.glass_ball(*SIZE, rays=9), nested_program(bands=BANDS, levels=5), path, name="a ball"
    )
    return path


@pytest.fixture(scope="module")
def ready(service: Service, ball: Path) -> tuple[str, str]:
    """A capture and its matte, both ready."""
    uploaded = service.client.upload(ball)
    service.client.wait(uploaded["job"])
    recovered = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])
    return uploaded["id"], str(recovered["matte"])


@contextmanager
def opened(browser: Browser, **options: Any) -> Iterator[Page]:
    """A page that fails the test if it throws, complains, breaks its policy or asks another host for anything."""
    context = browser.new_context(accept_downloads=True, **options)
    page = context.new_page()
    wrong: list[str] = []
    hosts: set[str] = set()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "console",
        lambda said: wrong.append(said.text) if said.type in ("error", "warning") else None,
    )
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    yield page
    context.close()
    assert [text for text in wrong if not any(said in text for said in SAID)] == []
    assert len(hosts - {""}) == 1  # what the page made itself has none


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    with opened(browser, viewport={"width": 1200, "height": 800}) as page:
        yield page


def pixels(data: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def shown(page: Page, image: str) -> NDArray[np.uint8]:
    """A picture as it is shown, (rows, columns, 3)."""
    url = page.evaluate(
        """(selector) => {
            const image = document.querySelector(selector);
            const [width, height] = [image.naturalWidth, image.naturalHeight];
            const canvas = Object.assign(document.createElement("canvas"), { width, height });
            canvas.getContext("2d").drawImage(image, 0, 0);
            return canvas.toDataURL("image/png");
        }""",
        image,
    )
    return pixels(base64.b64decode(url.partition(",")[2]))


def drop(page: Page, data: bytes, name: str) -> None:
    """Drop a file on the composite."""
    files = page.evaluate_handle(
        """([text, name]) => {
            const files = new DataTransfer();
            const data = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
            files.items.add(new File([data], name, { type: "image/png" }));
            return files;
        }""",
        [base64.b64encode(data).decode(), name],
    )
    page.get_by_role("group", name="Composite.").dispatch_event("drop", {"dataTransfer": files})


def picture(seed: int, width: int, height: int) -> bytes:
    """A backdrop."""
    blocks = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    return images.encode_png(np.kron(blocks, np.ones((height // 6, width // 8, 1), np.uint8)))


def is_fitting(page: Page) -> bool:
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))


def test_from_a_zip_to_a_composite(tab: Page, service: Service, ball: Path) -> None:
    tab.goto(service.url)
    tab.get_by_label("Choose a capture’s ZIP").set_input_files(ball)
    expect(tab).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    expect(tab.get_by_role("heading", name="a ball")).to_be_visible()
    expect(tab.get_by_role("heading", name="How it turned out")).to_be_visible(timeout=MINUTE)
    capture = service.client.capture(tab.url.rpartition("/")[2])
    report = service.http.get(capture["report"]).json()
    told = tab.locator(".findings li")
    expect(told).to_have_count(len(report["findings"]))
    for number, finding in enumerate(report["findings"]):
        expect(told.nth(number)).to_contain_text(finding["level"])
        expect(told.nth(number)).to_contain_text(finding["message"].replace("`", ""))
    expect(tab.get_by_alt_text("Some of the frames")).to_be_visible()
    tab.get_by_role("slider", name="Frame").fill("3")
    expect(tab.get_by_text(f"4 of {capture['frames']}")).to_be_visible()
    expect(tab.get_by_alt_text("Frame 4", exact=True)).to_be_visible()

    tab.get_by_label("Quality").select_option("fast")
    tab.get_by_role("button", name="Start").click()
    expect(tab).to_have_url(re.compile(r"#/jobs/\w+"))
    expect(tab.get_by_role("progressbar")).to_be_visible()
    expect(tab.get_by_alt_text("The composite of what is recovered so far")).to_be_visible(timeout=MINUTE)
    expect(tab.locator(".log li").first).to_contain_text("queued")
    tab.get_by_role("link", name="Open the matte").click(timeout=MINUTE)

    expect(tab).to_have_url(re.compile(r"#/mattes/\w+"))
    matte = tab.url.rpartition("/")[2]
    assert service.client.matte(matte)["options"]["quality"] == "fast"
    assert (
        service.client.matte(matte)["options"]["most_lobes"] == 2
    )  # as `fast` has it: nothing else was sent
    exact = re.compile(rf"^beach\.png: exact, {SIZE[0]} × {SIZE[1]} pixels")
    beach = picture(0, 1600, 1200)
    drop(tab, beach, "beach.png")
    expect(tab.get_by_text(exact)).to_be_visible(timeout=MINUTE)
    answer = service.http.post(
        f"/v1/mattes/{matte}/composite", content=beach, headers={"Accept": "image/png"}
    )
    error = np.mean((shown(tab, ".picture.stage img") - pixels(answer.content).astype(float)) ** 2)
    assert 10 * np.log10(255**2 / error) > 28


def test_a_backdrop_is_moved_by_hand_and_by_keys(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    status = tab.get_by_text("exact")
    expect(status).to_be_visible(timeout=MINUTE)
    stage = tab.get_by_role("group", name="Composite.")
    before = shown(tab, ".picture.stage img")
    box = stage.bounding_box()
    assert box
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url) if "/composite?" in request.url else None)
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + box["height"] / 2, steps=5)
    tab.mouse.up()
    right = tab.locator("output[for=place-right]")
    expect(right).to_have_text("25 %")
    expect(status).to_be_visible()
    assert "right=0.25" in asked[-1]
    assert "size=" not in asked[-1]
    assert np.mean(np.abs(shown(tab, ".picture.stage img") - before.astype(float))) > 5
    tab.mouse.wheel(0, -500)
    expect(tab.locator("output[for=place-scale]")).to_have_text("165 %")
    stage.focus()
    stage.press("ArrowLeft")
    expect(right).to_have_text("23 %")
    stage.press("]")
    expect(tab.locator("output[for=place-angle]")).to_have_text("2°")
    tab.get_by_role("slider", name="Size").press("End")
    expect(tab.locator("output[for=place-scale]")).to_have_text("1000 %")
    tab.get_by_role("button", name="Back to the start").click()
    expect(right).to_have_text("0 %")
    expect(status).to_be_visible()
    np.testing.assert_array_equal(shown(tab, ".picture.stage img"), before)
    for kind, magic in (("PNG", b"\x89PNG"), ("EXR", b"v/1\x01")):
        with tab.expect_download() as download:
            tab.get_by_role("button", name=kind, exact=True).click()
        assert download.value.suggested_filename == f"composite.{kind.lower()}"
        assert download.value.path().read_bytes().startswith(magic)


def test_layers_and_where_light_comes_from(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    for name in ("S", "alpha", "confidence", "rho"):
        tab.get_by_role("radio", name=name, exact=True).check()
        expect(tab.get_by_alt_text(f"The layer {name}")).to_be_visible()
        assert shown(tab, ".layer img").shape == (SIZE[1], SIZE[0], 3)
    layer = tab.get_by_role("group", name="Layer.")
    layer.focus()
    layer.press("ArrowRight")
    expect(tab.get_by_alt_text("pixel (49, 36)")).to_be_visible(timeout=MINUTE)
    layer.hover(position={"x": 5, "y": 5})
    expect(tab.get_by_alt_text("pixel (0, 0)")).to_be_visible()


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("holiday.zip", "application/zip", "no ZIP archive"),
        ("holiday.mp4", "video/mp4", "Put it into one ZIP with its capture.json"),
    ],
)
def test_a_wrong_file_is_refused_in_words(
    tab: Page, service: Service, name: str, kind: str, said: str
) -> None:
    tab.goto(service.url)
    file = {"name": name, "mimeType": kind, "buffer": b"twelve bytes"}
    tab.get_by_label("Choose a capture’s ZIP").set_input_files(file)  # type: ignore[arg-type]
    expect(tab.get_by_role("alert")).to_contain_text(said)
    tab.get_by_role("button", name="Dismiss").click()
    expect(tab.get_by_role("alert")).to_have_count(0)


def test_an_upload_that_breaks_off_goes_on(tab: Page, service: Service, ball: Path) -> None:
    asked: list[str] = []

    def cut(route: Route) -> None:
        asked.append(route.request.method)
        if asked.count("PATCH") == 1 and route.request.method == "PATCH":
            route.abort("connectionreset")
        else:
            route.continue_()

    tab.route("**/v1/uploads/**", cut)
    tab.goto(service.url)
    with tab.expect_console_message(lambda said: "ERR_CONNECTION_RESET" in said.text):
        tab.get_by_label("Choose a capture’s ZIP").set_input_files(ball)
    expect(tab.get_by_text("trying again")).to_be_visible()
    expect(tab).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    assert asked == ["PATCH", "HEAD", "PATCH"]


def test_a_wrong_option_is_refused_in_words(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/captures/{ready[0]}")
    known = {option["name"] for option in service.http.get("/v1/options").json()["options"]}
    tab.get_by_text("All options").click()
    fields = tab.locator("#recovery [name]")
    names = {fields.nth(n).get_attribute("name") for n in range(fields.count())}
    assert names == known
    # Past the browser's own check, as another version of the service would have other ranges.
    tab.locator("#recovery").evaluate("(form) => (form.noValidate = true)")
    tab.get_by_label("most lobes").fill("99")
    tab.get_by_role("button", name="Start").click()
    expect(tab.get_by_role("alert")).to_contain_text("'most_lobes': must be a whole number between 1 and 16")
    expect(tab.get_by_label("most lobes")).to_be_focused()


def test_a_reload_and_the_back_button_keep_the_view(
    tab: Page, service: Service, ready: tuple[str, str]
) -> None:
    capture, matte = ready
    tab.goto(service.url)
    tab.get_by_role("link", name="a ball").first.click()
    expect(tab.get_by_role("heading", name="a ball")).to_be_visible()
    tab.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    tab.locator(f'a[href="#/mattes/{matte}"]').click()
    title = tab.get_by_role("heading", name=f"Matte {matte[:8]}")
    expect(title).to_be_visible()
    tab.get_by_role("link", name="Skip").focus()
    tab.keyboard.press("Enter")
    expect(tab.locator("main")).to_be_focused()
    tab.reload()
    expect(title).to_be_visible()
    tab.go_back()
    expect(tab.get_by_role("heading", name="Mattes")).to_be_visible()
    tab.goto(f"{service.url}/#/captures/nothing")
    expect(tab.get_by_role("alert")).to_contain_text("Not found")
    assert service.client.capture(capture)


def test_a_job_is_cancelled_and_deleted(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    with paused(service):
        job = service.client.recover(ready[0])["id"]
        tab.goto(f"{service.url}/#/jobs/{job}")
        tab.get_by_role("button", name="Cancel").click()
        expect(tab.locator(".stage .badge")).to_have_text("cancelled")
    tab.get_by_role("button", name="Delete", exact=True).click()
    tab.get_by_role("button", name="Keep it").click()
    expect(tab.get_by_role("heading", name="Recovery of a matte")).to_be_visible()
    tab.get_by_role("button", name="Delete", exact=True).click()
    tab.get_by_role("button", name="Delete it").click()
    expect(tab).to_have_url(re.compile("#/jobs$"))
    assert service.http.get(f"/v1/jobs/{job}").status_code == 404


def test_a_service_with_keys_that_is_started_again(
    browser: Browser, ball: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("locked") / "data"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    settings = ("--workers", "1", "--port", port)
    with serving(folder, *settings, ENVMATTE_KEYS="secret") as locked:
        capture = locked.client.upload(ball)
        locked.client.wait(capture["job"])
        job = locked.client.recover(capture["id"])["id"]
        page = browser.new_page()
        page.goto(f"{locked.url}/#/jobs/{job}")
        for key in ("wrong", "secret"):
            page.get_by_label("Key of the service").fill(key)
            page.keyboard.press("Enter")
        expect(page.get_by_text(re.compile("running|queued")).first).to_be_visible()
        locked.kill()
        expect(page.get_by_text("The service does not answer")).to_be_visible(timeout=MINUTE)
    with serving(folder, *settings, ENVMATTE_KEYS="secret"):
        page.get_by_role("link", name="Open the matte").click(timeout=2 * MINUTE)
        expect(page.get_by_text("exact")).to_be_visible(timeout=MINUTE)
    assert page.evaluate("Object.keys(localStorage)") == []
    page.close()


def test_a_phone_shows_all_of_it_without_scrolling_sideways(
    browser: Browser, service: Service, ready: tuple[str, str]
) -> None:
    capture, matte = ready
    job = service.client.matte(matte)["job"]
    views = {
        "captures": "Captures", f"captures/{capture}": "Recover a matte", "jobs": "Jobs", f"jobs/{job}": "The frame",
        "mattes": "Mattes", f"mattes/{matte}": "Layers",
    }  # fmt: skip
    for scheme in ("light", "dark"):
        with opened(browser, viewport=PHONE, has_touch=True, is_mobile=True, color_scheme=scheme) as phone:
            for view, title in views.items():
                phone.goto(f"{service.url}/#/{view}")
                expect(phone.get_by_role("heading", name=title).first).to_be_visible()
                phone.wait_for_load_state("networkidle")
                assert is_fitting(phone), view
                assert phone.evaluate(UNNAMED) == [], view


def test_the_app_is_small_and_its_policy_strict(service: Service) -> None:
    files = [path for path in APP.iterdir() if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 100_000
    answer = service.http.get("/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    for name in re.findall(r'(?:href|src)="(web/[^"]*)"', answer.text):
        file = service.http.get(f"/{name}")
        assert file.status_code == 200
        assert file.headers["cache-control"] == "no-cache"
    named = {path.name for path in files if path.suffix == ".js"}
    assert named == set(re.findall(r"web/app/(\w+\.js)", answer.text))
