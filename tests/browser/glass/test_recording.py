"""What moves on the stage, recorded as a video."""

import av
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.browser.pages import SIZE
from tests.end_to_end.conftest import Service

pytestmark = pytest.mark.slow


def test_movement_is_recorded_as_a_video(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    expect(desk.get_by_text("exact")).to_be_visible()
    expect(desk.get_by_text("This browser draws the glass while you move")).to_be_visible()
    desk.get_by_role("button", name="Record", exact=True).click()
    stop = desk.get_by_role("button", name="Stop and save")
    expect(stop).to_have_attribute("aria-pressed", "true")
    stage = desk.get_by_role("group", name="Composite.")
    stage.focus()
    for _ in range(20):
        desk.keyboard.press("Shift+ArrowRight")
        desk.wait_for_timeout(50)  # a frame of the video, at least
    with desk.expect_download() as download:
        stop.click()
    expect(desk.get_by_role("button", name="Record", exact=True)).to_be_visible()
    name, _, kind = download.value.suggested_filename.rpartition(".")
    assert name == "a_ball"
    assert kind in ("mp4", "webm")
    with av.open(str(download.value.path())) as video:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in video.decode(video=0)]
    assert frames[0].shape == (SIZE[1], SIZE[0], 3)
    assert len(frames) > 3
    assert np.abs(frames[0] - frames[-1]).mean() > 5
    assert frames[-1].mean() > 20
