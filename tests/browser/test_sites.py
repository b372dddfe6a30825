"""What a website of others can do, by the browser of somebody on the machine, with a service that has no keys."""

import http.server
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from playwright.sync_api import Page

from tests.end_to_end.captures.test_bad_input import check_problem
from tests.end_to_end.conftest import Service

ASKED = {"preset": "sketch", "monitor": {"width": 64, "height": 48}}
SEND = """([url, asked]) => fetch(url, { method: "POST", mode: "no-cors", body: JSON.stringify(asked) })
    .then(({ status }) => status, ({ name }) => name)"""


@pytest.fixture
def site(tmp_path: Path) -> Iterator[str]:
    """Another website: another port is another origin."""
    (tmp_path / "index.html").write_text("<!doctype html><title>another</title>")
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_a_site_sends_nothing_to_a_service_without_keys(tab: Page, service: Service, site: str) -> None:
    url, before = f"{service.url}/v1/programs", service.http.get("/v1/programs").json()
    tab.goto(site)
    assert tab.evaluate(SEND, [url, ASKED]) == "TypeError"  # of the answer it is not told even the status
    assert service.http.get("/v1/programs").json() == before
    tab.goto(f"{service.url}/docs")  # where the same call is that of a page of the service
    assert tab.evaluate(SEND, [url, ASKED]) in (200, 201)
    made = service.http.get("/v1/programs").json()["programs"]
    assert len(made) > len(before["programs"])


@pytest.mark.parametrize(
    "name", ["evil.example", "evil.example:80", "localhost.evil.example", "10.0.0.1:8000", "[::2]", "["]
)
def test_a_name_that_leads_here_is_not_enough(service: Service, name: str) -> None:
    """As by DNS rebinding, where the site's own name leads to this machine, and its scripts may read answers."""
    for method, path in (
        ("GET", "/v1/captures"),
        ("GET", "/metrics"),
        ("DELETE", "/v1/jobs/x"),
        ("POST", "/v1/jobs"),
    ):
        answer = service.http.request(method, path, headers={"Host": name})
        assert "localhost" in check_problem(answer, 403, "foreign-site")["detail"]


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "127.1.2.3", "[::1]", "glass.localhost"])
def test_names_of_this_machine_are(service: Service, name: str) -> None:
    port = service.url.rpartition(":")[2]
    for host in (name, f"{name}:{port}"):
        assert service.http.get("/v1/captures", headers={"Host": host}).status_code == 200
        own = {"Host": host, "Origin": f"http://{host}"}
        assert service.http.post("/v1/jobs", json={}, headers=own).status_code == 422


@pytest.mark.parametrize("origin", ["null", "https://evil.example", "http://127.0.0.1:1", "http://[", "x"])
def test_an_origin_of_others_is_refused(service: Service, origin: str) -> None:
    check_problem(service.http.post("/v1/jobs", json={}, headers={"Origin": origin}), 403, "foreign-site")
