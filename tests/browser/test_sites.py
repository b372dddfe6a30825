"""What another website can do, in a browser on this machine, with a service without keys."""

import http.server
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from playwright.sync_api import Page

from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem

pytestmark = pytest.mark.slow

BODY = {"preset": "sketch", "monitor": {"width": 64, "height": 48}}
SEND = """([url, body]) => fetch(url, { method: "POST", mode: "no-cors", body: JSON.stringify(body) })
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


def test_foreign_site_cannot_send_to_service_without_keys(tab: Page, service: Service, site: str) -> None:
    def programs() -> list[str]:
        return [program["id"] for program in service.http.get("/v1/programs").json()["programs"]]

    url, before = f"{service.url}/v1/programs", programs()
    tab.goto(site)
    assert tab.evaluate(SEND, [url, BODY]) == "TypeError"  # not even the status of the response is visible
    assert programs() == before
    tab.goto(f"{service.url}/docs")  # a page of the service may make the same call
    assert tab.evaluate(SEND, [url, BODY]) in (200, 201)
    assert len(programs()) > len(before)


@pytest.mark.parametrize(
    "name", ["evil.example", "evil.example:80", "localhost.evil.example", "10.0.0.1:8000", "[::2]", "["]
)
def test_foreign_host_name_is_refused(service: Service, name: str) -> None:
    """As in DNS rebinding: the name of a site resolves to this machine, and its scripts could read responses."""
    for method, path in (
        ("GET", "/v1/captures"),
        ("GET", "/metrics"),
        ("DELETE", "/v1/jobs/x"),
        ("POST", "/v1/jobs"),
    ):
        answer = service.http.request(method, path, headers={"Host": name})
        assert "localhost" in check_problem(answer, 403, "foreign-site")["detail"]


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "127.1.2.3", "[::1]", "glass.localhost"])
def test_own_host_name_is_accepted(service: Service, name: str) -> None:
    port = service.url.rpartition(":")[2]
    for host in (name, f"{name}:{port}"):
        assert service.http.get("/v1/captures", headers={"Host": host}).status_code == 200
        own = {"Host": host, "Origin": f"http://{host}"}
        assert service.http.post("/v1/jobs", json={}, headers=own).status_code == 422


@pytest.mark.parametrize("origin", ["null", "https://evil.example", "http://127.0.0.1:1", "http://[", "x"])
def test_foreign_origin_is_refused(service: Service, origin: str) -> None:
    check_problem(service.http.post("/v1/jobs", json={}, headers={"Origin": origin}), 403, "foreign-site")
