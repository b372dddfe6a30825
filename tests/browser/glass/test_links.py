"""Links to a matte in pages of other websites."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from playwright.sync_api import Browser, expect

from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def link(service: Service, ready: tuple[str, str]) -> dict[str, str]:
    made: dict[str, str] = service.http.post(f"/v1/mattes/{ready[1]}/links", json={}).json()
    return made


@pytest.fixture
def website(service: Service, link: dict[str, str]) -> Iterator[str]:
    """Another website, whose page has a frame for each of the link's pages."""
    frames = "".join(
        f'<iframe name="{name}" src="{service.url}{link[name]}"></iframe>' for name in ("path", "embed")
    )

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = f"<!doctype html><title>a website</title>{frames}".encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *values: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}/"
        server.shutdown()


def test_only_the_embedded_page_is_shown_by_other_websites(browser: Browser, website: str) -> None:
    page = browser.new_page()
    page.goto(website)
    embedded = page.frame("embed")
    assert embedded is not None
    expect(embedded.locator("#choices")).to_be_visible()
    refused = page.frame("path")
    assert refused is not None
    until(lambda: refused.url.startswith("chrome-error:"))
    page.close()


def test_page_of_a_link_cannot_reach_the_service(
    browser: Browser, service: Service, link: dict[str, str]
) -> None:
    page = browser.new_page()
    page.goto(service.url + link["path"])
    expect(page.locator("#choices")).to_be_visible()
    assert page.evaluate("self.origin") == "null"
    fetched = page.evaluate("fetch('/v1/mattes').then(() => 'answered', () => 'refused')")
    assert fetched == "refused"
    assert page.evaluate("(() => { try { return localStorage.length } catch { return 'none' } })()") == "none"
    page.close()
