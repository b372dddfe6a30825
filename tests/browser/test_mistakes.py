"""What can go wrong, and what the app says: wrong files, lost connections, full disks, revoked keys."""

import io
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.browser.pages import MINUTE, ZIP, Held, asks_before_closing, opened, wait
from tests.end_to_end.conftest import Service, paused, serving
from tests.parts.disks import small_disk
from tests.parts.rig import free_port

pytestmark = pytest.mark.slow

DISK = 48 << 20


def empty_zip() -> bytes:
    """A ZIP that is no capture archive, as of an office document."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("document.xml", "<document/>")
    return file.getvalue()


def envmatte_keys(data: Path, *arguments: str) -> str:
    words = [sys.executable, "-m", "services", "keys", *arguments, "--data", str(data)]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("holiday.zip", b"twelve bytes", "neither a ZIP nor a film"),
        ("holiday.jpg", b"\xff\xd8\xff\xe0 and so on", "neither a ZIP nor a film"),
        ("holiday.docx", empty_zip(), "There is no capture.json"),
    ],
)
def test_wrong_file_is_refused_with_reason(
    desk: Page, service: Service, name: str, data: bytes, reason: str
) -> None:
    desk.goto(f"{service.url}/#/captures")
    file = {"name": name, "mimeType": "application/octet-stream", "buffer": data}
    desk.get_by_label(ZIP).set_input_files(file)  # type: ignore[arg-type]
    expect(desk.get_by_role("alert")).to_contain_text(reason)
    desk.get_by_role("button", name="Dismiss").click()
    expect(desk.get_by_role("alert")).to_have_count(0)


def test_file_dropped_beside_the_zone_does_not_replace_the_page(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/#/captures")
    files = desk.evaluate_handle(
        """() => {
            const files = new DataTransfer();
            files.items.add(new File(["twelve bytes"], "holiday.jpg"));
            return files;
        }"""
    )
    drop_outside = """() => new Promise((resolve) => {
        addEventListener("drop", (event) => setTimeout(() => resolve(event.defaultPrevented)), { once: true });
        document.querySelector("header").dispatchEvent(new DragEvent("drop", {
            dataTransfer: window.files, bubbles: true, cancelable: true }));
    })"""
    desk.evaluate("(files) => { window.files = files; }", files)
    assert desk.evaluate(drop_outside)
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()


def test_interrupted_upload_continues(desk: Page, service: Service, ball: Path) -> None:
    methods: list[str] = []

    def cut(route: Route) -> None:
        methods.append(route.request.method)
        if methods.count("PATCH") == 1 and route.request.method == "PATCH":
            route.abort("connectionreset")
        else:
            route.continue_()

    desk.route("**/v1/uploads/**", cut)
    desk.goto(f"{service.url}/#/captures")
    with desk.expect_console_message(lambda message: "ERR_CONNECTION_RESET" in message.text):
        desk.get_by_label(ZIP).set_input_files(ball)
    expect(desk.get_by_text("trying again")).to_be_visible()
    expect(desk).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    assert methods == ["PATCH", "HEAD", "PATCH"]


def test_upload_survives_other_views_and_the_back_button(desk: Page, service: Service, ball: Path) -> None:
    held = Held(desk, "**/v1/uploads/*", "PATCH")
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(ball)
    row = desk.get_by_role("region", name="ball.zip")
    expect(row).to_be_visible()
    desk.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    expect(desk.get_by_role("heading", name="Mattes")).to_be_visible()
    desk.go_back()
    expect(row).to_be_visible()
    desk.go_forward()
    upload = held.next()
    assert asks_before_closing(desk)
    upload.continue_()
    desk.unroute("**/v1/uploads/*")  # what is tried again after a broken connection is not held
    captures = desk.get_by_role("navigation").get_by_role("link", name="Captures")
    captures.click()
    expect(captures).to_have_attribute("aria-current", "page")  # the list of mattes shows no row
    expect(desk.get_by_text("a ball", exact=True).first).to_be_visible(timeout=MINUTE)
    expect(row).to_have_count(0, timeout=MINUTE)
    assert desk.evaluate("Object.keys(localStorage)") == []


def test_same_file_uploaded_in_two_tabs_is_one_capture(desk: Page, service: Service, ball: Path) -> None:
    before = {one["id"] for one in service.http.get("/v1/captures").json()["captures"]}
    desk.goto(f"{service.url}/#/captures")
    second = desk.context.new_page()
    second.goto(f"{service.url}/#/captures")
    uploads = []
    for page in (desk, second):
        held = Held(page, "**/v1/uploads/*", "PATCH")
        page.get_by_label(ZIP).set_input_files(ball)
        uploads.append(held.next())
        expect(page.get_by_role("region", name="ball.zip")).to_be_visible()
    for upload in uploads:
        upload.continue_()
    for page in (desk, second):
        page.unroute("**/v1/uploads/*")
        expect(page).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    assert desk.url == second.url
    made = {one["id"] for one in service.http.get("/v1/captures").json()["captures"]} - before
    assert made == {desk.url.rpartition("/")[2]}


def test_reload_and_back_button_keep_the_view(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    _, matte = ready
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_role("link", name="a ball").first.click()
    expect(desk.get_by_role("heading", name="a ball")).to_be_visible()
    desk.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    desk.locator(f'a[href="#/mattes/{matte}"]').click()
    title = desk.get_by_role("heading", name="a ball", exact=True)
    expect(title).to_be_visible()
    desk.get_by_role("link", name="Skip").focus()
    desk.keyboard.press("Enter")
    expect(desk.locator("main")).to_be_focused()
    desk.reload()
    expect(title).to_be_visible()
    desk.go_back()
    expect(desk.get_by_role("heading", name="Mattes")).to_be_visible()
    desk.goto(f"{service.url}/#/captures/nothing")
    expect(desk.get_by_role("alert")).to_contain_text("Not found")


@pytest.mark.exhaustive
def test_deleting_what_another_tab_deleted_succeeds(desk: Page, service: Service, ball: Path) -> None:
    capture = service.client.upload(ball)
    service.client.wait(capture["job"])
    recovered = service.client.wait(service.client.recover(capture["id"], quality="fast")["id"])
    for kind, one, title in (
        ("mattes", recovered["matte"], "Layers"),
        ("jobs", recovered["id"], "The frame"),
        ("captures", capture["id"], "Contact sheet"),
    ):
        desk.goto(f"{service.url}/#/{kind}/{one}")
        expect(desk.get_by_role("heading", name=title)).to_be_visible()
        assert service.http.delete(f"/v1/{kind}/{one}").status_code == 204
        desk.get_by_role("button", name="Delete", exact=True).click()
        desk.get_by_role("button", name=f"Delete {kind[:-1]}").click()
        expect(desk).to_have_url(re.compile(f"#/{kind}$"))
        expect(desk.get_by_role("alert")).to_have_count(0)
        desk.go_back()  # not to what was deleted
        expect(desk).not_to_have_url(re.compile(one))


def test_job_deleted_by_another_tab_is_not_found(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    with paused(service):
        job = service.client.recover(ready[0])["id"]
        desk.goto(f"{service.url}/#/jobs/{job}")
        cancel = desk.get_by_role("button", name="Cancel")
        expect(cancel).to_be_visible()
        # As if the connection were cut: the page learns nothing of the end.
        desk.route(f"**/v1/jobs/{job}/events", lambda route: route.abort("connectionreset"))
        desk.reload()
        expect(desk.get_by_text("trying again")).to_be_visible()
        service.http.post(f"/v1/jobs/{job}/cancel")
        wait(desk, lambda: service.http.delete(f"/v1/jobs/{job}").status_code == 204)
        desk.unroute(f"**/v1/jobs/{job}/events")
        expect(desk.get_by_role("alert")).to_contain_text("Not found", timeout=MINUTE)
        expect(cancel).to_have_count(0)


def test_file_removed_during_upload_is_named(desk: Page, service: Service, tmp_path: Path) -> None:
    film = tmp_path / "card.zip"
    film.write_bytes(b"PK\x03\x04" + bytes(9 << 20))  # more than one part
    held = Held(desk, "**/v1/uploads/*", "PATCH")
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(film)
    part = held.next()
    film.rename(tmp_path / "elsewhere")
    part.continue_()
    expect(desk.get_by_role("alert")).to_contain_text(
        "card.zip was changed, moved or removed", timeout=MINUTE
    )
    (tmp_path / "elsewhere").rename(film)
    desk.get_by_role("button", name="Continue", exact=True).click()
    assert held.next().request.header_value("upload-offset") == str(8 << 20)


@pytest.mark.exhaustive
def test_wrong_key_then_key_revoked_during_upload(browser: Browser, ball: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    with serving(data, "--workers", "1", ENVMATTE_KEYS="first") as locked, opened(browser) as page:
        lab = envmatte_keys(data, "make", "lab").split()[-1]
        page.goto(f"{locked.url}/#/captures")
        key = page.get_by_label("Key of the service")
        unknown = page.get_by_text("The service does not know this key")
        key.fill("ключ")  # no header can hold it
        page.keyboard.press("Enter")
        expect(unknown).to_be_visible()
        key.fill(lab)
        page.keyboard.press("Enter")
        held = Held(page, "**/v1/uploads/*", "PATCH")
        page.get_by_label(ZIP).set_input_files(ball)
        upload = held.next()
        envmatte_keys(data, "revoke", "lab")
        upload.continue_()
        expect(unknown).to_be_visible()
        page.keyboard.press("Escape")
        row = page.get_by_role("region", name="ball.zip")
        expect(row).to_contain_text("the bytes sent so far are kept")
        expect(unknown).to_be_hidden()
        page.unroute("**/v1/uploads/*")
        row.get_by_role("button", name="Continue", exact=True).click()
        key.fill("first")
        page.keyboard.press("Enter")
        expect(page.get_by_role("heading", name="a ball")).to_be_visible(timeout=MINUTE)


def test_full_disk_is_reported_and_upload_continues_with_room(
    browser: Browser, ball: Path, tmp_path: Path
) -> None:
    with small_disk(tmp_path / "disk", DISK) as disk, serving(disk / "data", "--workers", "1") as small:
        ballast = disk / "ballast"
        with ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(disk).free - (1 << 18))
        with opened(browser) as page:
            page.goto(f"{small.url}/#/captures")
            page.get_by_label(ZIP).set_input_files(ball)
            expect(page.get_by_role("alert")).to_contain_text("There is no room for it")
            expect(page.get_by_role("alert")).to_contain_text(re.compile("delete|room|free"))
            ballast.unlink()
            page.get_by_role("button", name="Continue", exact=True).click()
            expect(page).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
            expect(page.get_by_role("heading", name="a ball")).to_be_visible()


@pytest.mark.exhaustive
def test_service_restarts_with_another_key_during_upload(
    browser: Browser, ball: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "data"
    port = str(free_port())
    settings = ("--workers", "1", "--host", "0.0.0.0", "--port", port)
    with opened(browser) as page:
        with serving(folder, *settings, ENVMATTE_KEYS="first") as locked:
            page.goto(f"http://127.0.0.1:{port}/#/captures")
            for key in ("wrong", "first"):
                page.get_by_label("Key of the service").fill(key)
                page.keyboard.press("Enter")
            expect(page.get_by_label(ZIP)).to_be_visible()
            sent: list[str] = []

            def kill(route: Route) -> None:
                if route.request.method == "PATCH" and not sent:
                    locked.kill()
                    sent.append(route.request.method)
                route.continue_()

            page.route("**/v1/uploads/*", kill)
            page.get_by_label(ZIP).set_input_files(ball)
            expect(page.get_by_text("trying again")).to_be_visible(timeout=MINUTE)
        with serving(folder, *settings, ENVMATTE_KEYS="second"):
            expect(page.get_by_text("The service does not know this key")).to_be_visible(timeout=MINUTE)
            page.get_by_label("Key of the service").fill("second")
            page.keyboard.press("Enter")
            expect(page.get_by_role("heading", name="a ball")).to_be_visible(timeout=MINUTE)
            assert page.evaluate("[Object.keys(localStorage), Object.keys(sessionStorage)]") == [
                [],
                ["envmatte-key"],
            ]
            page.get_by_role("link", name="Film", exact=True).click()
            address = re.compile(rf"^http://[\d.]+:{port}/#/film$|This machine is not on a network")
            expect(page.get_by_text(address)).to_be_visible()


@pytest.mark.parametrize("action", ["delete", "film", "recover", "rename"])
def test_answer_that_comes_late_leaves_the_next_view_alone(
    desk: Page, service: Service, ready: tuple[str, str], action: str
) -> None:
    held = Held(desk, re.compile(r"/v1/\w+(/\w+)?$"), "DELETE", "PATCH", "POST")
    desk.goto(f"{service.url}/#/{'film' if action == 'film' else f'captures/{ready[0]}'}")
    if action == "delete":
        desk.get_by_role("button", name="Delete", exact=True).click()
        desk.get_by_role("button", name="Delete capture").click()
    elif action == "film":
        desk.get_by_role("button", name="Continue").dblclick()
    elif action == "recover":
        desk.get_by_role("button", name="Recover", exact=True).click()
    else:
        desk.get_by_role("button", name="Rename").click()
        desk.keyboard.press("Enter")
    change = held.next()
    desk.get_by_role("navigation").get_by_role("link", name="Mattes").click()
    expect(desk).to_have_title("Mattes · envmatte")
    assert held.routes == []  # also after a double click
    change.fulfill(json={"id": "made", "name": "a ball"})
    desk.wait_for_timeout(300)
    assert desk.url.endswith("#/mattes")
    assert desk.title() == "Mattes · envmatte"


def test_upload_cancelled_while_the_file_is_read_sends_nothing_more(
    desk: Page, service: Service, tmp_path: Path
) -> None:
    film = tmp_path / "card.zip"
    film.write_bytes(b"PK\x03\x04" + bytes(200_000))
    sent: list[str] = []
    desk.on("request", lambda request: sent.append(request.method))
    desk.goto(f"{service.url}/#/captures")
    # As from a slow disk.
    desk.evaluate(
        """() => {
            const { arrayBuffer } = Blob.prototype;
            Blob.prototype.arrayBuffer = async function () {
                if (this.size > 1e5) await new Promise((resolve) => Object.assign(window, { resolve }));
                return arrayBuffer.call(this);
            };
        }"""
    )
    desk.get_by_label(ZIP).set_input_files(film)
    desk.wait_for_function("() => window.resolve")
    desk.get_by_role("region", name="card.zip").get_by_role("button", name="Cancel").click()
    desk.evaluate("window.resolve()")
    desk.wait_for_timeout(1000)
    assert "PATCH" not in sent
