"""The preview of a matte in the app: one plays with the glass while the rest of it is recovered."""

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.pages import MINUTE, wait
from tests.end_to_end.conftest import Service, paused
from tests.end_to_end.mattes.test_previews import HEIGHT, WIDTH, upload_large
from tests.parts.waiting import until


@pytest.mark.exhaustive
def test_glass_is_in_the_hand_before_it_is_recovered(desk: Page, service: Service, tmp_path: Path) -> None:
    capture = upload_large(service, tmp_path / "ball.zip")
    job = service.client.recover(capture, quality="fast")
    until(lambda: service.client.job(job["id"])["stage"] == "recovering")
    with paused(service):
        desk.goto(f"{service.url}/#/jobs/{job['id']}")
        desk.get_by_role("link", name="Play with a preview").click()
        expect(desk.locator("h1 + .badge, .row .badge").first).to_have_text("recovering")
        stage = desk.get_by_role("group", name="Composite.")
        expect(desk.get_by_text("one pixel in 16 of it")).to_be_visible()
        expect(stage.locator("img")).to_be_visible()  # the service's composite, at full size
        assert stage.locator("img").evaluate("(image) => image.naturalWidth") == WIDTH
        box = stage.bounding_box()
        assert box
        desk.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        desk.mouse.down()
        desk.mouse.move(box["x"] + box["width"] / 3, box["y"] + box["height"] / 2, steps=5)
        drawn = stage.get_by_role("img", name="The glass before the backdrop")
        expect(drawn.and_(stage.locator("canvas"))).to_be_visible()  # drawn here, of the preview
        desk.mouse.up()
        expect(stage.locator("img")).to_be_visible()
        placed = desk.url
        expect(desk.get_by_text("replaces it step by step")).to_be_visible()
        expect(desk.get_by_role("button", name="Download the matte")).to_be_hidden()
        desk.get_by_role("button", name="Recover a part first").click()
        box = stage.bounding_box()  # the page may have scrolled
        assert box
        desk.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
        desk.mouse.down()
        desk.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] * 3 / 4, steps=3)
        desk.mouse.up()
        wait(desk, lambda: service.client.job(job["id"]).answer["region"])
        region = service.client.job(job["id"]).answer["region"]
        expected = {"x": WIDTH / 4, "y": HEIGHT / 2, "width": WIDTH / 4, "height": HEIGHT / 4}
        assert region == pytest.approx(expected, abs=3)
        assert desk.url == placed  # the backdrop did not move
        desk.get_by_role("button", name="Pause").click()
        desk.get_by_role("button", name="Continue").click()
        expect(desk.get_by_role("button", name="Pause")).to_be_visible()
        desk.route(f"**/v1/mattes/{job['matte']}", lambda route: route.abort("connectionreset"))
    expect(desk.get_by_role("alert")).to_contain_text("The service does not answer", timeout=2 * MINUTE)
    desk.unroute(f"**/v1/mattes/{job['matte']}")
    expect(desk.get_by_role("button", name="Download the matte")).to_be_visible()
    expect(desk.get_by_role("heading", name="Layers")).to_be_visible()
    expect(desk.get_by_text("This browser draws the glass while you move; when")).to_be_visible()
    assert "right=" in desk.url  # the placement stays


@pytest.mark.slow
def test_matte_is_shown_as_soon_as_there_is_something_to_see(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    with paused(service):
        matte = service.client.recover(ready[0], quality="fast")["matte"]
        desk.goto(f"{service.url}/#/mattes/{matte}")
        expect(desk.get_by_text("Not ready")).to_be_visible()
    expect(desk.get_by_text("exact")).to_be_visible()
