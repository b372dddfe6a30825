"""Lists: searched, filtered, and cleared of several entries at once, which can be undone."""

import re
from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

import pytest
from playwright.sync_api import Locator, Page, Route, expect

from tests.browser.pages import Held
from tests.end_to_end.conftest import Service, paused
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

NOT_NOW = {"title": "Not now", "detail": "the service is busy", "status": 409}


@pytest.fixture
def cancelled(service: Service, ready: tuple[str, str]) -> list[str]:
    """Two jobs that can be deleted."""
    with paused(service):
        jobs = [service.client.recover(ready[0])["id"] for _ in range(2)]
        for job in jobs:
            service.http.post(f"/v1/jobs/{job}/cancel")
    return jobs


def card(page: Page, job: str) -> Locator:
    return page.get_by_role("main").locator(f'a[href="#/jobs/{job}"]')


def choose(page: Page, jobs: list[str]) -> None:
    for job in jobs:
        page.get_by_role("checkbox", name=job).check()
    page.get_by_role("button", name=f"Delete {len(jobs)}", exact=True).click()
    for job in jobs:
        expect(card(page, job)).to_have_count(0)


def is_gone(service: Service, jobs: list[str]) -> Callable[[], bool]:
    return lambda: all(service.http.get(f"/v1/jobs/{job}").status_code == 404 for job in jobs)


def is_there(service: Service, jobs: list[str]) -> bool:
    return all(service.http.get(f"/v1/jobs/{job}").status_code == 200 for job in jobs)


def test_list_is_searched_and_filtered_by_state(desk: Page, service: Service, cancelled: list[str]) -> None:
    desk.goto(f"{service.url}/#/jobs")
    entries = desk.get_by_role("main").get_by_role("listitem")
    expect(card(desk, cancelled[0])).to_contain_text("Recovery of a matte: a ball")
    search = desk.get_by_role("searchbox", name="Search")
    search.fill(f" {cancelled[0].upper()} ")
    expect(entries).to_have_count(1)
    expect(card(desk, cancelled[0])).to_be_visible()
    search.fill("no such job")
    expect(entries).to_have_count(0)
    expect(desk.get_by_text("Nothing found")).to_be_visible()
    search.fill("")
    desk.get_by_label("State").select_option("succeeded")
    expect(card(desk, cancelled[0])).to_have_count(0)
    expect(entries.first).to_contain_text("succeeded")
    desk.get_by_label("State").select_option("cancelled")
    expect(card(desk, cancelled[1])).to_be_visible()
    expect(entries.filter(has_not_text="cancelled")).to_have_count(0)


def test_a_job_that_a_newer_service_queued_is_listed(
    desk: Page, service: Service, cancelled: list[str]
) -> None:
    def of_another_kind(route: Route) -> None:
        answer = route.fetch()
        found = answer.json()
        route.fulfill(response=answer, json={"jobs": [job | {"kind": "newer"} for job in found["jobs"]]})

    desk.route("**/v1/jobs?*", of_another_kind)
    desk.goto(f"{service.url}/#/jobs")
    expect(card(desk, cancelled[0])).to_contain_text("newer: a ball")


@pytest.mark.parametrize("kind", ["captures", "mattes"])
def test_names_are_searched(desk: Page, service: Service, ready: tuple[str, str], kind: str) -> None:
    desk.goto(f"{service.url}/#/{kind}")
    found = desk.locator(f'a[href="#/{kind}/{ready[kind == "mattes"]}"]')
    expect(found).to_be_visible()
    search = desk.get_by_role("searchbox", name="Search")
    search.fill("no such name")
    expect(found).to_have_count(0)
    expect(desk.get_by_text("Nothing found")).to_be_visible()
    search.fill(" A BAL ")
    expect(found).to_be_visible()


@pytest.mark.parametrize("outage", ["no connection", "a proxy alone", "another page"])
def test_list_comes_back_by_itself_after_an_outage(
    desk: Page, service: Service, ready: tuple[str, str], outage: str
) -> None:
    def fail(route: Route) -> None:
        if outage == "no connection":
            route.abort("connectionreset")
        elif outage == "a proxy alone":
            route.fulfill(status=502)
        else:  # as of the login of a hotel
            route.fulfill(body="<html>", content_type="text/html")

    desk.route("**/v1/captures?*", fail)
    desk.route("**/thumbnail.png", lambda route: route.abort("connectionreset"))
    desk.goto(f"{service.url}/#/captures")
    expect(desk.get_by_role("main").get_by_role("alert")).to_be_visible()
    box = desk.get_by_role("main").get_by_role("alert").bounding_box()
    again = desk.get_by_role("button", name="Try again").bounding_box()
    assert box
    assert again
    assert again["y"] - box["y"] - box["height"] >= 8
    desk.unroute("**/v1/captures?*")
    entry = desk.locator(f'a[href="#/captures/{ready[0]}"]')
    expect(entry).to_be_visible()
    expect(desk.get_by_role("main").get_by_role("alert")).to_have_count(0)
    desk.unroute("**/thumbnail.png")
    entry.scroll_into_view_if_needed()  # captures of other tests may be above it
    expect(entry.locator("img")).to_be_visible()


@pytest.fixture
def asked(desk: Page) -> list[dict[str, list[str]]]:
    """The queries to a service with 120 captures, as far as the app can tell, which finds them by name."""
    captures = [
        {
            "id": f"c{n:03}",
            "name": f"glass {n:03}",
            "state": "ready",
            "frames": 9,
            "bytes": 900,
            "created_at": "2026-01-01T00:00:00Z",
        }
        for n in range(120)
    ]
    asked: list[dict[str, list[str]]] = []

    def answer(route: Route) -> None:
        query = parse_qs(urlsplit(route.request.url).query)
        asked.append(query)
        found = [one for one in captures if query.get("name", [""])[0] in str(one["name"])]
        first = [one["id"] for one in found].index(query["after"][0]) + 1 if "after" in query else 0
        route.fulfill(json={"captures": found[first : first + 50]})

    desk.route("**/v1/captures?*", answer)
    desk.route("**/v1/captures/*/thumbnail.png", lambda route: route.fulfill(status=404, json=NOT_NOW))
    return asked


def test_search_looks_into_all_pages(desk: Page, service: Service, asked: list[dict[str, list[str]]]) -> None:
    desk.goto(f"{service.url}/#/captures")
    entries = desk.get_by_role("main").locator("ul.list > li")
    expect(entries).to_have_count(50)
    desk.get_by_role("button", name="Show older").click()
    expect(entries).to_have_count(100)
    search = desk.get_by_role("searchbox", name="Search")
    asked.clear()
    search.fill("glass 11")
    expect(entries).to_have_count(10)
    assert asked == [{"limit": ["50"], "name": ["glass 11"]}]
    desk.get_by_label("Choose all that are shown").check()
    expect(desk.get_by_role("button", name="Delete 10", exact=True)).to_be_visible()
    # What is found may take more than a page.
    search.fill("glass 0")
    expect(entries).to_have_count(50)
    desk.get_by_role("button", name="Show older").click()
    expect(entries).to_have_count(100)


def test_search_wins_over_older_entries_that_come_late(
    desk: Page, service: Service, asked: list[dict[str, list[str]]]
) -> None:
    held = Held(desk, re.compile("after="))
    desk.goto(f"{service.url}/#/captures")
    entries = desk.get_by_role("main").locator("ul.list > li")
    desk.get_by_role("button", name="Show older").click()
    older = held.next()
    desk.get_by_role("searchbox", name="Search").fill("glass 11")
    desk.wait_for_timeout(500)
    older.fallback()
    desk.wait_for_timeout(500)
    expect(entries).to_have_count(10)


def test_deletion_is_undone(desk: Page, service: Service, cancelled: list[str]) -> None:
    desk.clock.install()
    desk.goto(f"{service.url}/#/jobs")
    choose(desk, cancelled)
    bar = desk.get_by_role("status").filter(has_text="Jobs deleted: 2")
    bar.get_by_role("button", name="Undo").click()
    for job in cancelled:
        expect(card(desk, job)).to_be_visible()
    desk.clock.fast_forward(20_000)
    expect(bar).to_have_count(0)
    assert is_there(service, cancelled)
    # Without it they are deleted after some seconds.
    choose(desk, cancelled)
    assert is_there(service, cancelled)
    desk.clock.fast_forward(20_000)
    expect(bar).to_have_count(0)
    until(is_gone(service, cancelled))


@pytest.mark.parametrize("way", ["another view", "another page"])
def test_leaving_deletes_at_once(desk: Page, service: Service, cancelled: list[str], way: str) -> None:
    desk.goto(f"{service.url}/#/jobs")
    choose(desk, cancelled)
    assert is_there(service, cancelled)
    if way == "another view":
        desk.get_by_role("navigation").get_by_role("link", name="Captures").click()
    else:
        desk.goto("about:blank")
    until(is_gone(service, cancelled))


def test_what_cannot_be_deleted_comes_back(desk: Page, service: Service, cancelled: list[str]) -> None:
    kept, lost = cancelled
    desk.route(
        f"**/v1/jobs/{kept}",
        lambda route: (
            route.fulfill(status=409, json=NOT_NOW, content_type="application/problem+json")
            if route.request.method == "DELETE"
            else route.continue_()
        ),
    )
    desk.clock.install()
    desk.goto(f"{service.url}/#/jobs")
    choose(desk, cancelled)
    desk.clock.fast_forward(20_000)
    expect(card(desk, kept)).to_be_visible()
    expect(desk.get_by_role("main").get_by_role("alert")).to_contain_text("The service is busy")
    expect(card(desk, lost)).to_have_count(0)
    until(is_gone(service, [lost]))
    assert is_there(service, [kept])
