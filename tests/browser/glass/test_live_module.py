"""The module that other pages draw the glass with: it is the app's, and draws what the service composites."""

import functools
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from services.api.mattes.live_page import PAGE
from tests.browser.glass.test_live_page import composite, drawn, psnr
from tests.browser.pages import opened
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service, png
from workflows.simulation import glass_ball

pytestmark = pytest.mark.slow


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and logs nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def written(service: Service, ready: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder as the command line writes it."""
    folder = tmp_path_factory.mktemp("module") / "glass"
    done = envmatte(service, "layers", ready[1], str(folder), "--for", "glsl")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def site(written: Path) -> Iterator[str]:
    """A web server of the folder, which is not the service."""
    handler = functools.partial(Quiet, directory=str(written))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_page_draws_what_the_service_composites(
    browser: Browser, site: str, service: Service, ready: tuple[str, str]
) -> None:
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    with opened(browser, viewport={"width": 1000, "height": 700}) as page:
        page.goto(f"{site}/glass.html")
        before = drawn(page)
        page.locator("input").set_input_files({"name": "beach.png", "mimeType": "image/png", "buffer": beach})
        expect(page.get_by_role("status")).to_be_empty()
        found = drawn(page)
        assert psnr(found, before) < 20
        assert psnr(found, composite(service, ready[1], beach)) > 30
        notes = {"name": "notes.txt", "mimeType": "text/plain", "buffer": b"no picture"}
        page.locator("input").set_input_files(notes)
        expect(page.get_by_role("status")).to_have_text("This browser cannot read the file as a picture.")
        wide = png(np.zeros((1, 20_000, 3)), "srgb", np.uint8)
        page.locator("input").set_input_files({"name": "wide.png", "mimeType": "image/png", "buffer": wide})
        expect(page.get_by_role("status")).to_contain_text(
            "The picture has 20000 x 1 pixels, and this device"
        )


IMAGE = """<!doctype html>
<canvas></canvas><img src="beach.png" style="width: 16px">
<script type="module">
import { openGlass } from "./envmatte.js";
const glass = await openGlass(document.querySelector("canvas"), "matte.live", [1280, 960]);
const image = document.querySelector("img");
await image.decode();
glass.setBackdrop(image);
glass.draw();
</script>"""


def test_image_of_a_page_has_its_own_pixels_however_small_it_is_shown(
    browser: Browser, site: str, written: Path, service: Service, ready: tuple[str, str]
) -> None:
    beach = png(glass_ball.backdrop(640, 480), "srgb", np.uint8)
    (written / "beach.png").write_bytes(beach)
    (written / "image.html").write_text(IMAGE)
    with opened(browser) as page:
        page.goto(f"{site}/image.html")
        assert psnr(drawn(page), composite(service, ready[1], beach)) > 30


def test_matte_that_is_not_there_is_explained(browser: Browser, site: str, written: Path) -> None:
    (written / "elsewhere.html").write_text(
        (written / "glass.html").read_text().replace("matte.live", "no.live")
    )
    page = browser.new_page()
    page.goto(f"{site}/elsewhere.html")
    expect(page.get_by_role("status")).to_have_text("no.live: 404 File not found")
    page.close()


def test_module_has_the_shaders_of_the_app_once(written: Path) -> None:
    module, shaders = (written / "envmatte.js").read_text(), PAGE.parent / "app/composite/live/webgl.js"
    assert module.startswith("// Glass in a web page")
    assert module.rstrip().endswith("export const { openGlass } = module2;")
    for shader in shaders.read_text().split("#version 300 es")[1:]:
        assert module.count(shader.partition("`")[0]) == 1
    assert len((written / "glass.html").read_text().splitlines()) < 110


def test_page_is_an_attachment(service: Service, ready: tuple[str, str]) -> None:
    answer = service.http.get(f"/v1/mattes/{ready[1]}/layers/glass.html")
    assert answer.headers["content-disposition"] == "attachment"
    assert service.http.get(f"/v1/mattes/{ready[1]}/layers/matte.live").content[:2] == b"\x1f\x8b"
