"""What the app says when something is missing, slow or named oddly."""

import io
import re
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.pages import ZIP, Held, unfold
from tests.end_to_end.conftest import Service

pytestmark = pytest.mark.slow

SHOWN = """async ([detail, entry]) => {
    const { problemBox } = await import("/web/app/lib/dom.js");
    document.querySelector("main").append(problemBox({ title: "Refused", detail, entry }));
    const text = document.querySelector("main .problem:last-child p");
    return [text.textContent, getComputedStyle(text, "::first-letter").textTransform];
}"""
STAGE = """async (job) => {
    const { followJob } = await import("/web/app/lib/job_progress.js");
    const panel = document.createElement("section");
    const stop = new AbortController();
    followJob(panel, "none", stop.signal, () => {}, job).catch(() => {});
    stop.abort();
    return panel.querySelector(".stage").textContent;
}"""
FOLLOWED = """async (job) => {
    const { followJob } = await import("/web/app/lib/job_progress.js");
    window.panel = document.createElement("section");
    followJob(panel, "none", new AbortController().signal, () => {}, job);
    return panel.querySelector(".stage").textContent;
}"""
RATIOS = """(image) => [image.parentElement.clientWidth / image.parentElement.clientHeight,
    image.naturalWidth / image.naturalHeight]"""


@pytest.mark.parametrize(
    ("detail", "entry", "shown"),
    [
        ("the white frame is clipped", None, "The white frame is clipped"),
        ("beach.png is cut off", None, "beach.png is cut off"),
        ("ball is cut off", "ball", "ball is cut off"),
        ("most_lobes: must be a number", None, "most_lobes: must be a number"),
    ],
)
def test_sentences_begin_with_a_capital_and_names_stay(
    desk: Page, service: Service, detail: str, entry: str | None, shown: str
) -> None:
    desk.goto(service.url)
    expect(desk.get_by_role("heading", level=1)).to_be_visible()
    assert desk.evaluate(SHOWN, [detail, entry]) == [shown, "none"]


def test_list_that_failed_can_be_tried_again(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    desk.route("**/v1/mattes?*", lambda route: route.fulfill(status=500))
    desk.goto(f"{service.url}/#/mattes")
    again = desk.get_by_role("button", name="Try again")
    expect(desk.get_by_role("alert")).to_contain_text("The service answered with 500")
    again.click()
    expect(again).to_be_enabled()
    desk.unroute("**/v1/mattes?*")
    again.click()
    expect(desk.locator(f'a[href="#/mattes/{ready[1]}"]')).to_be_visible()
    expect(desk.get_by_role("alert")).to_have_count(0)
    expect(again).to_have_count(0)


def test_seconds_until_the_next_attempt_are_counted_down(desk: Page, service: Service, ball: Path) -> None:
    desk.route(
        "**/v1/uploads/*",
        lambda route: (
            route.abort("connectionreset") if route.request.method == "PATCH" else route.continue_()
        ),
    )
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(ball)
    for seconds in (3, 2):  # of four: the pauses are of 1, 2, 4 and 8 s
        expect(desk.get_by_text(re.compile(rf"trying again in {seconds}\.\d s"))).to_be_visible()
    desk.unroute("**/v1/uploads/*")
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"))


def test_what_is_gone_is_explained_without_calls_of_the_api(desk: Page, service: Service) -> None:
    for kind in ("captures", "jobs", "mattes"):
        desk.goto(f"{service.url}/#/{kind}/nothing")
        expect(desk.get_by_role("alert")).to_contain_text("It was deleted")
        expect(desk.get_by_role("alert")).not_to_contain_text("/v1/")


def test_no_picture_is_shown_until_there_is_one(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    held = Held(desk, "**/layers/rho.png")
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    unfold(desk)
    image = desk.locator(".layer img")
    expect(image).to_be_hidden()
    held.next().continue_()
    expect(image).to_be_visible()


def test_contact_sheet_of_any_shape_is_not_squeezed(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    target = io.BytesIO()
    Image.new("RGB", (1000, 1060), "grey").save(target, "PNG")  # of four by four frames
    desk.route("**/contact-sheet.png", lambda route: route.fulfill(body=target.getvalue()))
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    image = desk.get_by_alt_text("Some of the frames side by side")
    expect(image).to_be_visible()
    desk.wait_for_timeout(200)
    frame, picture = image.evaluate(RATIOS)
    assert frame == pytest.approx(picture, rel=0.02)


@pytest.mark.parametrize(
    ("stage", "eta", "text"),
    [
        ("ingesting", 12, "running ingesting, 50 %, about 12 s left"),
        ("finishing", 40, "running measuring and writing the report, about 40 s left"),
        ("finishing", 0, "running measuring and writing the report"),
    ],
)
def test_last_step_of_an_ingest_is_named(
    desk: Page, service: Service, stage: str, eta: float, text: str
) -> None:
    desk.goto(service.url)
    expect(desk.get_by_role("heading", level=1)).to_be_visible()
    job = {"kind": "ingest", "state": "running", "stage": stage, "progress": 0.5, "eta_seconds": eta}
    assert desk.evaluate(STAGE, job | {"tiles": {"total": 1, "done": 1, "failed": 0}}) == text


def test_time_left_runs_down_while_no_event_comes(desk: Page, service: Service) -> None:
    desk.clock.install()
    desk.route("**/v1/jobs/none/*", lambda route: None)
    desk.goto(f"{service.url}/#/jobs")
    expect(desk.get_by_role("heading", level=1)).to_be_visible()
    job = {"kind": "ingest", "state": "running", "stage": "finishing", "progress": 0.5, "eta_seconds": 20}
    assert "about 20 s left" in desk.evaluate(FOLLOWED, job | {"tiles": {"total": 1, "done": 1, "failed": 0}})
    for seconds, left in ((5, ", about 15 s left"), (14, ", about 1.0 s left"), (2, "")):
        desk.clock.run_for(1000 * seconds)
        shown = "running measuring and writing the report" + left
        assert desk.evaluate("window.panel.querySelector('.stage').textContent") == shown


@pytest.mark.parametrize("kind", ["capture", "matte"])
def test_capture_or_matte_is_renamed_in_place(
    desk: Page, service: Service, ready: tuple[str, str], kind: str
) -> None:
    path = f"{kind}s/{ready[kind == 'matte']}"
    desk.goto(f"{service.url}/#/{path}")
    title = desk.get_by_role("heading", level=1)
    expect(title).to_have_text("a ball")
    for name in ('<b>"glass" & more</b>', "a ball"):
        desk.get_by_role("button", name="Rename").click()
        desk.get_by_label(f"Name of the {kind}").fill("something else")
        desk.keyboard.press("Escape")
        desk.get_by_role("button", name="Rename").click()
        desk.keyboard.press("Control+A")
        desk.keyboard.type(name)
        desk.keyboard.press("Enter")
        expect(title).to_have_text(name)
        expect(desk).to_have_title(f"{name} · envmatte")
        assert service.http.get(f"/v1/{path}").json()["name"] == name
    desk.reload()
    expect(title).to_have_text("a ball")


def test_question_mark_shows_the_keys(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/#/captures")
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
    keys = desk.get_by_role("dialog", name="Keys")
    expect(keys).to_be_hidden()
    desk.keyboard.press("?")
    expect(keys).to_contain_text("arrows move the backdrop")
    desk.keyboard.press("Escape")
    expect(keys).to_be_hidden()
    desk.get_by_label(ZIP).press("?")  # no key of the page while a field has the focus
    expect(keys).to_be_hidden()
