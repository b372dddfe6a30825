"""Links to a matte, made and deleted in the app."""

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import Held
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

pytestmark = pytest.mark.slow


def test_link_is_made_used_and_deleted(
    browser: Browser, desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    before = len(service.http.get(f"/v1/mattes/{ready[1]}/links").json()["links"])
    desk.get_by_role("heading", name="Share").click()
    panel = desk.get_by_role("main").locator("details", has=desk.get_by_role("heading", name="Share"))
    expect(panel.get_by_role("listitem")).to_have_count(before)
    panel.get_by_label("Expires after").select_option("7")
    panel.get_by_role("button", name="Make a link").click()
    link = panel.get_by_label("Link", exact=True)
    expect(link).to_be_visible()
    expect(panel.get_by_role("listitem")).to_have_count(before + 1)
    url = link.input_value()
    assert url.startswith(f"{service.url}/share/")
    assert "/embed/" in panel.get_by_label("For another page").input_value()
    reader = browser.new_page()
    assert (answer := reader.goto(url)) is not None
    assert answer.status == 200
    expect(reader.locator("#choices")).to_be_visible()
    reader.close()
    panel.get_by_role("button", name="Delete the link").first.click()
    expect(panel.get_by_role("listitem")).to_have_count(before)
    expect(link).to_have_count(0)
    until(lambda: service.http.get(url).status_code == 404)


def test_links_that_come_late_or_not_at_first(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    path = f"/v1/mattes/{ready[1]}/links"
    held = Held(desk, f"**{path}", "GET")
    desk.goto(f"{service.url}/#/mattes/{ready[1]}")
    heading = desk.get_by_role("heading", name="Share")
    heading.click()
    held.next().fulfill(status=500)
    panel = desk.get_by_role("main").locator("details", has=heading)
    expect(panel.get_by_role("alert")).to_be_visible()
    for _ in range(2):  # closed, and opened again
        heading.click()
        desk.wait_for_timeout(200)
    panel.get_by_role("button", name="Make a link").click()
    expect(panel.get_by_role("listitem")).to_have_count(1)
    held.next().continue_()
    desk.wait_for_timeout(300)
    expect(panel.get_by_role("listitem")).to_have_count(len(service.http.get(path).json()["links"]))
    # A link is shown only once, so none is made before its address is known.
    desk.route("**/v1/network", lambda route: route.abort("connectionreset"))
    before = service.http.get(path).json()
    panel.get_by_role("button", name="Make a link").click()
    expect(panel.get_by_role("alert")).to_contain_text("The service does not answer")
    assert service.http.get(path).json() == before
