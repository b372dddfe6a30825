"""QR codes: of the service's own addresses, and of no others."""

from collections.abc import Callable
from xml.etree import ElementTree

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from services.api.system import network


@pytest.fixture
def http(build: Callable[..., FastAPI], monkeypatch: pytest.MonkeyPatch) -> TestClient:
    """A service with a key that listens on all addresses, of which one is 192.168.1.5."""
    monkeypatch.setattr(network, "_own_address", lambda: "192.168.1.5")
    return TestClient(build(host="0.0.0.0", keys=("given",)), "http://glass.test")


def ask(http: TestClient, text: str) -> httpx2.Response:
    return http.get("/v1/qr.svg", params={"text": text})


@pytest.mark.parametrize(
    "text",
    [
        "http://glass.test/#/film/0123456789abcdef0123",
        "https://glass.test/",  # behind a proxy
        "http://192.168.1.5:80/#/film",
    ],
)
def test_own_address_is_drawn_without_a_key_and_kept_by_browsers(http: TestClient, text: str) -> None:
    answer = ask(http, text)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/svg+xml")
    assert answer.headers["cache-control"] == "public, max-age=86400"
    picture = ElementTree.fromstring(answer.text)
    _, _, width, height = map(int, picture.attrib["viewBox"].split())
    assert width == height >= 8 + 21  # a quiet zone of four modules around the smallest code
    assert ask(http, text).content == answer.content != ask(http, text + "1").content


@pytest.mark.parametrize(
    "text",
    [
        "http://elsewhere.test/",
        "http://glass.test.elsewhere.test/",
        "http://glass.test@elsewhere.test/",
        "http://glass.test:81/",
        "http://192.168.1.5:81/",
        "javascript://glass.test/%0aalert(1)",
        "//glass.test/",
        "http://[",
        "glass.test",
        "",
        "http://glass.test/" + 200 * "x",
    ],
)
def test_other_texts_are_refused(http: TestClient, text: str) -> None:
    answer = ask(http, text)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:envmatte:problem:bad-request")


def test_service_on_loopback_has_no_other_address(build: Callable[..., FastAPI]) -> None:
    http = TestClient(build(), "http://localhost:8000")
    assert ask(http, "http://localhost:8000/#/film").status_code == 200
    assert ask(http, "http://127.0.0.1:8000/#/film").status_code == 422
    assert ask(http, "http:///").status_code == 422
