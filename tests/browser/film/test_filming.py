"""Filming: a program is chosen, played on a monitor, followed on a phone and recorded by a camera of the browser."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import MINUTE, PHONE, ZIP, Held, asks_before_closing, opened
from tests.end_to_end.conftest import Service
from workflows.programs.program import Program

pytestmark = pytest.mark.slow

SCREEN = {"width": 640, "height": 360}
SHORT = {
    "monitor": SCREEN,
    "parts": [
        {"kind": "constant", "levels": [0, 1]},
        {"kind": "bernoulli", "columns": 8, "rows": 6, "count": 10, "seed": 1, "colour": "grey"},
    ],
}
KEPT = """async (count) => {
    const { allFilms } = await import("/web/app/upload/kept_films.js");
    return (await allFilms()).filter(({ capture }) => !capture).length === count;
}"""


def test_preset_is_fitted_to_the_screen(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/#/film")
    expect(desk.get_by_text("where no other device can reach it")).to_be_visible()
    expect(desk.get_by_label("The monitor’s width")).to_have_value("1200")
    desk.get_by_role("radio", name="sketch").check()
    desk.get_by_label("Height").fill("40")
    desk.get_by_role("button", name="Continue").click()
    expect(desk.get_by_role("alert")).to_be_visible()
    desk.get_by_label("Height").fill("800")
    desk.get_by_role("button", name="Continue").click()
    expect(desk.get_by_role("heading", name="37 patterns on a screen of 1200 × 800")).to_be_visible()
    made = service.http.get(f"/v1/programs/{desk.url.rpartition('/')[2]}").json()
    assert (made["patterns"], made["display"]) == (37, {"width": 1200, "height": 800})
    desk.get_by_role("link", name="Filming").click()
    expect(desk.get_by_role("link", name="37 patterns on a screen of 1200 × 800").first).to_be_visible()


def test_phone_reads_the_address_off_the_screen(desk: Page, service: Service) -> None:
    desk.route("**/v1/network", lambda route: route.fulfill(json={"url": service.url}))
    desk.goto(f"{service.url}/#/film")
    code = desk.get_by_role("img", name="The address as a QR code")
    expect(code).to_be_visible()
    expect(code).not_to_have_js_property("naturalWidth", 0)
    assert desk.request.get(str(code.evaluate("(image) => image.src"))).ok
    expect(desk.get_by_text(f"{service.url}/#/film", exact=True)).to_be_visible()


def test_program_is_followed_and_recorded(browser: Browser, desk: Page, service: Service) -> None:
    made = service.http.post(
        "/v1/programs", json={"program": SHORT, "monitor": SCREEN, "border": True}
    ).json()
    url = f"{service.url}/#/film/{made['id']}"
    desk.goto(url)
    with opened(browser, viewport=PHONE, is_mobile=True, has_touch=True) as phone:
        phone.goto(url)
        before = phone.get_by_role("checkbox")
        expect(before).to_have_count(8)
        phone.get_by_text("Darken the room").tap()
        expect(before.nth(4)).to_be_checked()
        live = phone.get_by_role("timer")
        expect(live).to_have_text("Not started")
        desk.get_by_role("button", name="Use a camera of this device").click()
        expect(desk.get_by_role("button", name="Start recording")).to_be_visible()
        with desk.expect_popup() as popup:
            desk.get_by_role("link", name="Play it on this screen").click()
        monitor = popup.value
        monitor.set_viewport_size({"width": 640, "height": 360})
        expect(monitor.get_by_role("status")).to_have_text("Ready.", timeout=MINUTE)
        monitor.get_by_label("Patterns a second").fill("4")
        monitor.get_by_role("button", name="full screen").press("Enter")
        expect(live).to_have_text(re.compile(r"Starts in \d"))
        expect(desk.get_by_role("button", name="Stop recording")).to_be_visible()
        expect(live).to_have_text(re.compile(r"\d+ of 12"), timeout=MINUTE)
        expect(live).to_have_text("All shown", timeout=MINUTE)
        expect(phone.get_by_text("a second. Stop recording")).to_be_visible()
    # The film is uploaded by itself, as a film of this program.
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    capture = service.client.capture(desk.url.rpartition("/")[2])
    assert (capture["name"], capture["frames"]) == ("film", 12)
    assert Program.model_validate(capture["program"]) == Program.model_validate(made["program"])
    # The fake camera does not see the monitor, so ingest finds no program in the film.
    expect(desk.get_by_role("alert")).to_contain_text("film.", timeout=2 * MINUTE)
    for _ in range(2):  # and after a reload
        film = desk.get_by_role("region", name="The film")
        expect(film.get_by_label("The film’s first frame")).not_to_have_js_property("videoWidth", 0)
        with desk.expect_download() as download:
            film.get_by_role("button", name="Save the film").click()
        assert download.value.path().stat().st_size > 1000
        desk.reload()
    film.get_by_role("link", name="Film again").click()
    expect(desk).to_have_url(url)
    expect(desk.get_by_role("button", name="Use a camera of this device")).to_be_visible()


def test_followers_see_countdown_progress_and_stop(desk: Page, service: Service) -> None:
    made = service.http.post(
        "/v1/programs", json={"program": SHORT, "monitor": SCREEN, "border": True}
    ).json()
    desk.goto(f"{service.url}/#/film/{made['id']}")
    live = desk.get_by_role("timer")
    for report, text in (
        ({"phase": "countdown", "seconds": 12}, re.compile(r"Starts in [1-9]$")),
        # Again, by a page that was reloaded.
        ({"phase": "countdown", "seconds": 12}, re.compile(r"Starts in 1\d$")),
        ({"phase": "stopped"}, "Stopped"),
        ({"phase": "showing", "shown": 5}, re.compile("of 12")),
    ):
        body = {"patterns_per_second": 0.1} | report
        assert service.http.put(f"/v1/programs/{made['id']}/showing", json=body).status_code == 204
        expect(live).to_contain_text(text)
    for wrong, status in (({"phase": "dancing"}, 422), ({"phase": "shown", "patterns_per_second": -1}, 422)):
        assert service.http.put(f"/v1/programs/{made['id']}/showing", json=wrong).status_code == status
    assert service.http.put("/v1/programs/none/showing", json=body).status_code == 404
    text = {"name": "holiday.txt", "mimeType": "text/plain", "buffer": b"twelve bytes"}
    still = {"name": "holiday.nef", "mimeType": "", "buffer": b"twelve bytes"}
    for files, why in (
        ([text], "Choose the video that the camera recorded, or all stills"),
        ([still, still], "The program shows 12 pictures, and you chose 2 stills"),
    ):
        desk.get_by_label("Choose the film").set_input_files(files)
        expect(desk.get_by_role("alert")).to_contain_text(why)


def shown(service: Service, program: str, phase: str) -> None:
    """Report the phase of a program as its player page would."""
    report = {"phase": phase, "patterns_per_second": 4, "shown": 12}
    assert service.http.put(f"/v1/programs/{program}/showing", json=report).status_code == 204


def filming(page: Page, service: Service) -> str:
    """Start recording a new program; returns its id."""
    made = service.http.post(
        "/v1/programs", json={"program": SHORT, "monitor": SCREEN, "border": True}
    ).json()
    page.goto(f"{service.url}/#/captures")
    page.goto(f"{service.url}/#/film/{made['id']}")
    page.get_by_role("button", name="Use a camera of this device").click()
    page.get_by_role("button", name="Start recording").click()
    expect(page.get_by_role("button", name="Stop recording")).to_be_visible()
    return str(made["id"])


@pytest.mark.parametrize(
    ("failure", "why"),
    [("NotReadableError", "Another program uses the camera"), ("AbortError", "cannot start it (AbortError)")],
)
def test_camera_that_fails_is_explained_in_our_words(
    desk: Page, service: Service, failure: str, why: str
) -> None:
    made = service.http.post("/v1/programs", json={"preset": "sketch", "border": True}).json()
    desk.add_init_script(
        f"navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException('raw', '{failure}'))"
    )
    desk.goto(f"{service.url}/#/film/{made['id']}")
    desk.get_by_role("button", name="Use a camera of this device").click()
    expect(desk.get_by_role("alert")).to_contain_text(why)


def test_recording_continues_while_another_view_is_shown(desk: Page, service: Service) -> None:
    program = filming(desk, service)
    note = desk.get_by_role("link", name="Recording a film")
    expect(note).to_be_hidden()
    desk.go_back()
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
    desk.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    expect(desk.get_by_role("heading", name="Mattes")).to_be_visible()
    assert asks_before_closing(desk)
    note.click()
    expect(desk.get_by_role("button", name="Stop recording")).to_be_visible()
    expect(desk.get_by_label("Choose the film")).to_be_attached()
    expect(note).to_be_hidden()
    assert not desk.get_by_label("What the camera sees").evaluate("(video) => video.paused")
    desk.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    expect(desk.get_by_role("heading", name="Mattes")).to_be_visible()
    expect(note).to_be_visible()
    before = {one["id"] for one in service.http.get("/v1/captures").json()["captures"]}
    shown(service, program, "shown")
    expect(note).to_be_hidden(timeout=MINUTE)
    while not (
        made := [
            one for one in service.http.get("/v1/captures").json()["captures"] if one["id"] not in before
        ]
    ):
        desk.wait_for_timeout(100)
    assert [one["name"] for one in made] == ["film"]
    expect(desk.get_by_role("heading", name="Mattes")).to_be_visible()
    desk.go_back()
    expect(desk.get_by_role("button", name="Use a camera of this device")).to_be_visible()


def test_interrupted_film_is_kept_until_user_decides(desk: Page, service: Service) -> None:
    program = filming(desk, service)
    shown(service, program, "stopped")
    row = desk.get_by_role("region", name=re.compile("^film\\."))
    expect(row).to_contain_text("The program stopped before its end")
    desk.go_back()
    expect(row).to_be_visible()
    desk.get_by_role("navigation").get_by_role("link", name="Film").click()
    expect(desk.get_by_role("heading", name="Choose a program")).to_be_visible()
    expect(row).to_be_visible()
    desk.wait_for_function(KEPT, arg=1)
    desk.reload()
    expect(row).to_contain_text("not uploaded yet. The program stopped before its end")
    row.get_by_role("button", name="Discard").click()
    desk.get_by_role("button", name="Cancel").click()
    with desk.expect_download() as download:
        row.get_by_role("button", name="Save").click()
    assert download.value.path().stat().st_size > 1000
    row.get_by_role("button", name="Upload").click()
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    expect(desk.get_by_role("heading", name="film", exact=True)).to_be_visible()
    desk.reload()
    expect(desk.get_by_role("heading", name="film", exact=True)).to_be_visible()
    expect(row).to_have_count(0)


def test_film_waits_in_one_page_until_it_is_discarded(desk: Page, service: Service) -> None:
    program = filming(desk, service)
    shown(service, program, "stopped")
    row = desk.get_by_role("region", name=re.compile("^film\\."))
    expect(row).to_contain_text("The program stopped before its end")
    desk.wait_for_function(KEPT, arg=1)
    other = desk.context.new_page()
    other.goto(f"{service.url}/#/captures")
    expect(other.get_by_role("heading", name="Captures")).to_be_visible()
    other.wait_for_load_state("networkidle")
    expect(other.get_by_role("region", name=re.compile("^film\\."))).to_have_count(0)
    other.close()
    row.get_by_role("button", name="Discard").click()
    desk.get_by_role("button", name="Discard film").click()
    expect(row).to_have_count(0)
    desk.wait_for_function(KEPT, arg=0)


def test_film_is_uploaded_after_a_reload(desk: Page, service: Service) -> None:
    desk.route("**/v1/uploads", lambda route: route.abort("connectionreset"))
    program = filming(desk, service)
    shown(service, program, "shown")
    row = desk.get_by_role("region", name=re.compile("^film\\."))
    expect(row).to_contain_text("The service does not answer")
    desk.wait_for_function(KEPT, arg=1)
    desk.on("dialog", lambda dialog: dialog.accept())  # an upload is under way
    desk.reload()
    expect(row).to_contain_text("not uploaded yet.")
    desk.unroute("**/v1/uploads")
    row.get_by_role("button", name="Upload").click()
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    assert service.client.capture(desk.url.rpartition("/")[2])["name"] == "film"


def test_another_upload_does_not_end_a_recording(desk: Page, service: Service, ball: Path) -> None:
    filming(desk, service)
    held = Held(desk, "**/v1/uploads/*", "PATCH")
    desk.get_by_role("navigation").get_by_role("link", name="Captures").click()
    desk.get_by_label(ZIP).set_input_files(ball)
    row = desk.get_by_role("region", name="ball.zip")
    upload = held.next()
    desk.go_back()
    expect(row).to_be_visible()
    upload.continue_()
    expect(row).to_be_hidden(timeout=MINUTE)
    desk.wait_for_timeout(500)
    expect(desk.get_by_role("button", name="Stop recording")).to_be_visible()


def test_former_playback_does_not_end_a_recording(desk: Page, service: Service) -> None:
    made = service.http.post(
        "/v1/programs", json={"program": SHORT, "monitor": SCREEN, "border": True}
    ).json()
    shown(service, made["id"], "shown")
    held = Held(desk, "**/v1/programs/*/events")
    filming(desk, service)
    with desk.expect_response("**/v1/programs/*/events"):
        held.next().continue_()
    desk.wait_for_timeout(1500)  # longer than recording continues after a program
    expect(desk.get_by_role("button", name="Stop recording")).to_be_visible()


def test_outage_is_said_while_a_program_is_followed(desk: Page, service: Service) -> None:
    made = service.http.post("/v1/programs", json={"program": SHORT, "monitor": SCREEN}).json()
    desk.route("**/v1/programs/*/events", lambda route: route.abort("connectionreset"))
    desk.goto(f"{service.url}/#/film/{made['id']}")
    away = desk.get_by_text("The service does not answer; trying again.")
    expect(away).to_be_visible()
    desk.wait_for_timeout(600)  # more than twice as long as between two drawings of the progress
    assert away.is_visible()
    desk.unroute("**/v1/programs/*/events")
    expect(desk.get_by_text("Open the player on the monitor")).to_be_visible()


def test_camera_that_is_slow_to_open_and_to_lock(desk: Page, service: Service) -> None:
    desk.add_init_script(
        """
        const held = window.held = [];
        const wait = () => new Promise((resolve) => held.push(resolve));
        const { getUserMedia } = navigator.mediaDevices;
        navigator.mediaDevices.getUserMedia = async (wanted) => {
            await wait();
            return getUserMedia.call(navigator.mediaDevices, wanted);
        };
        MediaStreamTrack.prototype.getCapabilities = () => ({ focusMode: ["manual"] });
        MediaStreamTrack.prototype.applyConstraints = wait;
        """
    )
    desk.route("**/v1/uploads", lambda route: None)  # the film stays here
    made = service.http.post("/v1/programs", json={"program": SHORT, "monitor": SCREEN}).json()
    desk.goto(f"{service.url}/#/film/{made['id']}")
    desk.get_by_role("button", name="Use a camera of this device").click()
    desk.evaluate("held.pop()()")
    which = desk.get_by_label("Camera", exact=True)
    expect(which).to_be_enabled()
    which.dispatch_event("change")
    expect(which).to_be_disabled()  # two at once would leave one of them on
    desk.evaluate("held.pop()()")
    expect(which).to_be_enabled()
    desk.get_by_role("button", name="Start recording").click()
    desk.get_by_role("button", name="Stop recording").click()
    done = desk.get_by_text("Recorded.")
    expect(done).to_be_visible()
    desk.evaluate("held.pop()()")
    desk.wait_for_timeout(200)
    assert done.is_visible()
