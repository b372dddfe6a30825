"""Jobs in the app: followed, cancelled, retried, deleted."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import MINUTE, ZIP, Held, wait
from tests.end_to_end.conftest import Service, paused, serving
from tests.parts.rig import free_port

pytestmark = pytest.mark.slow


def test_invalid_option_is_explained(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    known = {option["name"] for option in service.http.get("/v1/options").json()["options"]}
    desk.get_by_text("Expert").click()
    fields = desk.locator("#recovery [name]")
    names = {fields.nth(n).get_attribute("name") for n in range(fields.count())}
    assert names == known
    # Bypass the browser's own check, as if another version of the service had other ranges.
    desk.locator("#recovery").evaluate("(form) => (form.noValidate = true)")
    desk.get_by_label("most lobes").fill("99")
    desk.get_by_role("button", name="Recover", exact=True).click()
    expect(desk.get_by_role("alert")).to_contain_text("'most_lobes': must be a whole number between 1 and 16")
    expect(desk.get_by_label("most lobes")).to_be_focused()


def test_the_object_is_cut_out_unless_that_is_unticked(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    def asked() -> bool:
        desk.get_by_role("button", name="Recover", exact=True).click()
        expect(desk).to_have_url(re.compile(r"#/jobs/\w+"))
        job = service.client.cancel(desk.url.rpartition("/")[2])
        return bool(job["options"].get("cut_out"))

    for is_cut in (True, False):
        desk.goto(f"{service.url}/#/captures/{ready[0]}")
        desk.get_by_label("Cut the object out").set_checked(is_cut)
        assert asked() is is_cut


def test_job_is_cancelled_and_deleted(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    with paused(service):
        job = service.client.recover(ready[0])["id"]
        desk.goto(f"{service.url}/#/jobs/{job}")
        desk.get_by_role("button", name="Cancel").click()
        expect(desk.locator(".stage .badge")).to_have_text("cancelled")
    desk.get_by_role("button", name="Delete", exact=True).click()
    desk.get_by_role("button", name="Cancel").click()
    expect(desk.get_by_role("heading", name="Recovery of a matte")).to_be_visible()
    expect(desk.get_by_role("button", name="Delete", exact=True)).to_be_focused()
    desk.get_by_role("button", name="Delete", exact=True).click()
    desk.get_by_role("button", name="Delete job").click()
    expect(desk).to_have_url(re.compile("#/jobs$"))
    assert service.http.get(f"/v1/jobs/{job}").status_code == 404


def test_failed_job_says_why_and_is_retried(desk: Page, service: Service, ball: Path, tmp_path: Path) -> None:
    capture = service.client.upload(ball)
    service.client.wait(capture["job"])
    frames = sorted((service.data / "store").glob(f"captures/{capture['id']}/**/c/**/*"))
    lost = next(path for path in frames if path.is_file())
    lost.rename(tmp_path / "lost")
    job = service.client.recover(capture["id"], quality="fast")["id"]
    desk.goto(f"{service.url}/#/jobs/{job}")
    expect(desk.get_by_role("alert")).to_contain_text("Stored data is missing or damaged", timeout=MINUTE)
    (tmp_path / "lost").rename(lost)
    desk.get_by_role("button", name="Try again").click()
    expect(desk.get_by_role("link", name="Open the matte")).to_be_visible(timeout=MINUTE)
    expect(desk.locator(".log")).to_contain_text("succeeded")


def test_running_job_is_followed_across_a_reload(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    with paused(service):
        job = service.client.recover(ready[0], quality="fast")["id"]
        desk.goto(f"{service.url}/#/jobs")
        card = desk.get_by_role("main").locator(f'a[href="#/jobs/{job}"]')
        card.focus()
        desk.keyboard.press("Enter")
        expect(desk.get_by_role("button", name="Cancel")).to_be_visible()
        desk.reload()
        expect(desk.get_by_role("button", name="Cancel")).to_be_visible()
        expect(desk.get_by_role("progressbar")).to_be_visible()
    requests: list[str] = []
    desk.on("request", lambda request: requests.append(request.url) if request.url.endswith(job) else None)
    expect(desk.get_by_role("link", name="Open the matte")).to_be_visible(timeout=MINUTE)
    assert requests == []  # events bring the state, without polling


def test_running_job_shows_progress(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    job = service.client.recover(ready[0], most_lobes=16)["id"]
    while (at := service.client.job(job))["eta_seconds"] is None:
        desk.wait_for_timeout(20)
    with paused(service):
        desk.goto(f"{service.url}/#/jobs/{job}")
        expect(desk.locator("p.stage")).to_have_text(re.compile(r"running recovering, \d+ %, about .+ left"))
        facts = {"Tiles": rf"[1-9]\d* of {at['tiles']['total']}", "Workers": "1", "Ran": r".+ (s|min)"}
        for name, value in facts.items():
            shown = desk.get_by_label("Progress").get_by_role("term").filter(has_text=name).locator("+ dd")
            expect(shown).to_have_text(re.compile(f"^{value}$"))
        expect(desk.get_by_role("progressbar")).not_to_have_js_property("value", 0)
        expect(desk.get_by_role("list", name="Log")).to_contain_text("recovering")
    service.http.post(f"/v1/jobs/{job}/cancel")


def test_job_is_followed_again_after_sleep(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    requests: list[str | None] = []
    desk.on(
        "request",
        lambda one: (
            requests.append(one.headers.get("last-event-id")) if one.url.endswith("/events") else None
        ),
    )
    read: list[str] = []
    desk.on("request", lambda one: read.append(one.url) if "/log?" in one.url else None)
    desk.clock.install()
    with paused(service):
        job = service.client.recover(ready[0], quality="fast")["id"]
        desk.goto(f"{service.url}/#/jobs/{job}")
        expect(desk.locator(".stage .badge")).to_have_text("running")
        expect(desk.get_by_label("Progress").get_by_role("term")).not_to_have_count(0)
        wait(desk, lambda: len(read) >= 2)  # the log, for the known state and for the first event
        assert requests == [None]
        desk.clock.fast_forward("08:00:00")
        wait(desk, lambda: len(requests) > 1)
        assert requests[1]  # resumes after the last event received
        expect(desk.locator(".stage .badge")).to_have_text("running")  # though there is no new one
    expect(desk.get_by_role("link", name="Open the matte")).to_be_visible(timeout=MINUTE)


@pytest.mark.exhaustive
def test_restarted_service_with_keys(
    browser: Browser, ball: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("locked") / "data"
    port = str(free_port())
    settings = ("--workers", "1", "--port", port)
    with serving(folder, *settings, ENVMATTE_KEYS="secret") as locked:
        capture = locked.client.upload(ball)
        locked.client.wait(capture["job"])
        # Paused, lest it ends before the service does.
        job = locked.client.pause(locked.client.recover(capture["id"]))["id"]
        page = browser.new_page()
        page.goto(f"{locked.url}/#/jobs/{job}")
        for key in ("wrong", "secret"):
            page.get_by_label("Key of the service").fill(key)
            page.keyboard.press("Enter")
        expect(page.locator(".stage .badge")).to_have_text("paused")
        locked.kill()
        expect(page.get_by_text("The service does not answer")).to_be_visible(timeout=MINUTE)
    with serving(folder, *settings, ENVMATTE_KEYS="secret") as again:
        again.client.resume(job)
        page.get_by_role("link", name="Open the matte").click(timeout=2 * MINUTE)
        expect(page.get_by_text("exact")).to_be_visible(timeout=MINUTE)
    assert page.evaluate("Object.keys(localStorage)") == []
    page.close()


def test_recovery_follows_the_ingest_by_itself(desk: Page, service: Service, ball: Path) -> None:
    with paused(service):
        desk.goto(f"{service.url}/#/captures")
        desk.get_by_label(ZIP).set_input_files(ball)
        expect(desk.get_by_label("Recover automatically when ready")).to_be_checked()
        expect(desk.get_by_role("list", name="Steps").locator("[aria-current=step]")).to_have_text("Check")
        desk.get_by_role("radio", name="Draft").check()
    expect(desk).to_have_url(re.compile("#/mattes/"), timeout=3 * MINUTE)
    matte = service.client.matte(desk.url.rpartition("/")[2])
    assert matte["options"]["quality"] == "fast"
    service.client.wait(matte["job"])
    desk.get_by_role("list", name="Steps").get_by_role("link", name="Check").click()
    expect(desk.get_by_role("region", name="Mattes").get_by_role("link")).to_have_attribute(
        "href", f"#/mattes/{matte['id']}"
    )


@pytest.mark.parametrize("lost", ["captures/*/report", "jobs"])
def test_recovery_follows_the_ingest_after_an_outage(
    desk: Page, service: Service, ball: Path, lost: str
) -> None:
    desk.route(f"**/v1/{lost}", lambda route: route.abort("connectionreset"))
    with paused(service):
        capture = service.client.upload(ball)
        desk.goto(f"{service.url}/#/captures/{capture['id']}")
        desk.get_by_role("radio", name="Draft").check()
    expect(desk.get_by_role("alert")).to_contain_text("The service does not answer", timeout=MINUTE)
    desk.unroute(f"**/v1/{lost}")
    expect(desk).to_have_url(re.compile("#/mattes/"), timeout=2 * MINUTE)
    service.client.wait(service.client.matte(desk.url.rpartition("/")[2])["job"])


def test_activity_lists_the_last_jobs(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    with paused(service):
        job = service.client.recover(ready[0])["id"]
        desk.goto(f"{service.url}/#/captures")
        activity = desk.get_by_role("button", name=re.compile("Activity.*1"))
        activity.press("Enter")
        menu = desk.get_by_role("region", name="Activity")
        expect(menu.get_by_role("link").first).to_have_attribute("href", f"#/jobs/{job}")
        service.http.post(f"/v1/jobs/{job}/cancel")
        expect(menu.get_by_role("link").first).to_contain_text("cancelled")
    menu.get_by_role("link", name="All jobs").click()
    expect(desk.get_by_role("heading", name="Jobs")).to_be_visible()
    expect(menu).to_be_hidden()


def test_count_of_the_activity_is_right_after_an_outage(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    desk.clock.install()
    with paused(service):
        job = service.client.recover(ready[0])["id"]
        desk.goto(f"{service.url}/#/captures")
        activity = desk.get_by_role("button", name="Activity")
        expect(activity).to_contain_text("1")
        desk.route("**/v1/jobs?*", lambda route: route.abort("connectionreset"))
        with desk.expect_console_message(lambda message: "ERR_CONNECTION_RESET" in message.text):
            desk.clock.fast_forward(5000)
        desk.wait_for_timeout(1000)  # it is asked for twice
        service.http.post(f"/v1/jobs/{job}/cancel")
        desk.unroute("**/v1/jobs?*")
        desk.clock.fast_forward(5000)
        expect(activity).not_to_contain_text("1")


@pytest.mark.parametrize("leaves", [True, False])
def test_answer_about_the_matte_may_come_after_the_end(
    desk: Page, service: Service, ready: tuple[str, str], leaves: bool
) -> None:
    held = Held(desk, "**/v1/mattes/*")
    with paused(service):
        job = service.client.recover(ready[0], quality="fast")["id"]
        desk.goto(f"{service.url}/#/jobs/{job}")
        expect(desk.get_by_role("button", name="Cancel")).to_be_visible()
    expect(desk.get_by_role("link", name="Open the matte")).to_be_visible(timeout=MINUTE)
    answer = held.next()
    if leaves:
        desk.get_by_role("link", name="Jobs").first.click()
        expect(desk.get_by_role("heading", name="Jobs")).to_be_visible()
    else:
        answer.fulfill(json={"preview": True})
        desk.wait_for_timeout(200)
        expect(desk.get_by_role("button", name="Cancel")).to_be_hidden()  # the job is not running again


@pytest.mark.parametrize("clicked", [True, False])
def test_view_that_failed_to_load_is_loaded_again(
    desk: Page, service: Service, ready: tuple[str, str], clicked: bool
) -> None:
    desk.route("**/v1/mattes/*", lambda route: route.abort("connectionreset"))
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    again = desk.get_by_role("button", name="Try again")
    expect(again).to_be_visible()
    desk.unroute("**/v1/mattes/*")
    if clicked:  # else after some seconds
        again.click()
    expect(desk.get_by_role("heading", name="a ball")).to_be_visible()
    expect(desk.get_by_role("alert")).to_have_count(0)
