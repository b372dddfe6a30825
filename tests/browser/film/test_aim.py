"""Help before a film: the camera's picture is judged, and the program starts once all is well."""

import base64
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, expect
from scipy import ndimage

from tests.browser.conftest import ARGUMENTS, WINDOWLESS
from tests.browser.pages import MINUTE, opened, phase_of
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until
from workflows.programs.border import LEAD, Border, draw_border

pytestmark = pytest.mark.slow

SCREEN = {"width": 640, "height": 360}
JUDGE = """async ([first, then]) => {
    const { look } = await import("/web/app/film/look.js");
    const { judge } = await import("/web/app/film/aim.js");
    const frame = ([width, height, data]) =>
        ({ width, height, light: Uint8Array.from(atob(data), (one) => one.charCodeAt(0)) });
    return judge(look(frame(then), first && frame(first)));
}"""
WELL: dict[str, str | None] = dict.fromkeys(("screen", "exposure", "sharpness", "movement"))
UNSEEN = WELL | {"screen": "unseen"}


def seen(
    size: tuple[int, int] = (800, 450),
    screen: tuple[int, int] = (1920, 1080),
    share: float = 0.6,
    at: tuple[float, float] = (0.5, 0.5),
    angle: float = 0.0,
    light: tuple[float, float] = (12, 200),
    blur: float = 0.7,
    noise: float = 1.5,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """What a camera sees of a screen that shows white in the border, behind a glass; `light` is of black and white."""
    width, height = size
    step = screen[0] / (share * width)
    border = Border(width=screen[0], height=screen[1])
    shown = draw_border(np.full((1, 1, 1), 255, np.uint8), LEAD, border)[..., 0] / 255
    shown = ndimage.gaussian_filter(shown, 0.5 * step)
    y, x = np.mgrid[:height, :width].astype(float)
    across, down = x - at[0] * width, y - at[1] * height
    u = (np.cos(angle) * across + np.sin(angle) * down) * step + screen[0] / 2
    v = (-np.sin(angle) * across + np.cos(angle) * down) * step + screen[1] / 2
    level = ndimage.map_coordinates(shown, [v, u], order=1, cval=0.0)
    from_glass = np.hypot(across / width, (y - 0.62 * height) / height)
    level *= np.where(from_glass < 0.13, 0.35 + 0.5 * np.sin(40 * from_glass) ** 2, 1)
    # Its foot hides the border.
    level *= np.where((abs(across) < 0.12 * width) & (down > 0.22 * height), 0.2, 1)
    picture = ndimage.gaussian_filter(light[0] + (light[1] - light[0]) * level, blur)
    picture += np.random.default_rng(seed).normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def sent(frame: NDArray[np.uint8]) -> list[Any]:
    return [*frame.shape[::-1], base64.b64encode(frame.tobytes()).decode()]


def plain(*lines: int) -> NDArray[np.uint8]:
    """A bright page in a dark room, with some lines of text."""
    frame = np.full((450, 800), 10, np.uint8)
    frame[80:380, 150:650] = 220
    for line in lines:
        frame[line : line + 5, 180:620] = 60
    return frame


@pytest.mark.parametrize(
    ("draw", "wrong"),
    [
        pytest.param(seen, WELL, id="well"),
        pytest.param(partial(seen, angle=0.12, share=0.5), WELL, id="tilted"),
        pytest.param(partial(seen, share=0.35), WELL, id="far"),
        pytest.param(partial(seen, screen=(1280, 1024)), WELL, id="5 to 4"),
        pytest.param(partial(seen, size=(450, 800), share=0.8), WELL, id="upright"),
        pytest.param(partial(seen, light=(70, 200)), WELL, id="lit room"),
        pytest.param(partial(seen, share=0.9, at=(0.7, 0.5)), WELL | {"screen": "cut"}, id="cut off"),
        pytest.param(partial(seen, light=(12, 300)), WELL | {"exposure": "bright"}, id="clipped"),
        pytest.param(partial(seen, light=(6, 60)), WELL | {"exposure": "dark"}, id="dark"),
        pytest.param(partial(seen, blur=6), WELL | {"sharpness": "blurred"}, id="blurred"),
        pytest.param(plain, UNSEEN, id="a page"),
        pytest.param(partial(plain, *range(100, 360, 12)), UNSEEN, id="a page of text"),
        pytest.param(partial(np.full, (450, 800), 90, np.uint8), UNSEEN, id="grey"),
    ],
)
def test_picture_of_the_camera_is_judged(
    desk: Page, service: Service, draw: Callable[[], NDArray[np.uint8]], wrong: dict[str, str | None]
) -> None:
    desk.goto(f"{service.url}/#/film")
    assert desk.evaluate(JUDGE, [None, sent(draw())]) == wrong


def test_movement_is_seen_and_noise_is_none(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/#/film")
    before = sent(seen(noise=4))
    for frame, wrong in ((seen(noise=4, seed=1), None), (seen(noise=4, at=(0.51, 0.5), seed=1), "moves")):
        assert desk.evaluate(JUDGE, [before, sent(frame)]) == WELL | {"movement": wrong}


@pytest.fixture
def filmed_screen(browser: Browser, tmp_path: Path) -> Iterator[Browser]:
    """Another browser, whose camera sees a screen that shows white in the border."""
    frame = seen(size=(640, 480), share=0.7)
    colours = np.full((2, 240, 320), 128, np.uint8).tobytes()
    one = b"FRAME\n" + frame.tobytes() + colours
    path = tmp_path / "camera.y4m"
    path.write_bytes(b"YUV4MPEG2 W640 H480 F10:1 Ip A1:1 C420jpeg\n" + 4 * one)
    running = browser.browser_type.launch(
        executable_path=WINDOWLESS, args=[*ARGUMENTS, f"--use-file-for-fake-video-capture={path}"]
    )
    yield running
    running.close()


def test_program_starts_when_all_is_well(filmed_screen: Browser, service: Service) -> None:
    shown = {"preset": "sketch", "monitor": SCREEN, "border": True}
    program = service.http.post("/v1/programs", json=shown).json()["id"]

    with opened(filmed_screen, viewport={"width": 1200, "height": 800}) as page:
        page.goto(f"{service.url}/#/film/{program}")
        expect(page.get_by_role("img", name="The camera on a tripod")).to_be_visible()
        page.get_by_role("button", name="Use a camera of this device").click()
        found = page.get_by_role("list", name="Ready to film?")
        for text in (
            "The whole screen is seen",
            "White is bright",
            "The screen is sharp",
            "Everything is at rest",
        ):
            expect(found).to_contain_text(text)
        expect(page.get_by_role("meter", name="Exposure")).not_to_have_js_property("value", 0)
        until(lambda: phase_of(service, program) == "countdown")
        expect(page.get_by_role("button", name="Stop recording")).to_be_visible(timeout=MINUTE)
        expect(found).to_be_hidden()
        page.get_by_role("button", name="Stop recording").click()
        expect(page).to_have_url(f"{service.url}/#/film/{program}")


def test_program_waits_while_no_screen_is_seen(desk: Page, service: Service) -> None:
    shown = {"preset": "sketch", "monitor": {"width": 656, "height": 368}, "border": True}
    program = service.http.post("/v1/programs", json=shown).json()["id"]
    desk.goto(f"{service.url}/#/film/{program}")
    desk.get_by_role("button", name="Use a camera of this device").click()
    found = desk.get_by_role("list", name="Ready to film?")
    expect(found).to_contain_text("I don’t see the screen")  # the usual camera shows something else
    expect(desk.get_by_label("Start by itself when all is well")).to_be_checked()
    assert service.http.get(f"/v1/programs/{program}").json()["showing"] is None
