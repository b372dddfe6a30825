"""Links to a matte, made and deleted in the app."""

import pytest
from playwright.sync_api import Browser, Page, expect

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
