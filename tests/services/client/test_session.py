"""Requests of the client: which failures are retried, and how long it waits."""

import io
import json
import threading
import time
from collections.abc import Callable
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from services.client import Busy, Client, ServiceError, Unreachable
from services.client._session import FIRST_PAUSE, LONGEST_PAUSE
from tests.services.client.servers import JOB, Answer, ok, refusal, scripted_server, web_server


def test_unreachable_service_is_named() -> None:
    with (
        Client("http://127.0.0.1:9") as client,
        pytest.raises(ServiceError, match=r"127\.0\.0\.1:9.*envmatte serve"),
    ):
        client.job("any")


def test_error_page_of_a_proxy_becomes_an_error() -> None:
    class Proxy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(502)

        def log_message(self, *arguments: object) -> None:
            pass

    with (
        web_server(Proxy) as url,
        Client(url) as client,
        pytest.raises(ServiceError, match="502 Bad Gateway") as caught,
    ):
        client.job("any")
    assert caught.value.problem["status"] == 502


@pytest.mark.parametrize("body", [b'{"title": "x"', b"[1]", b"\xff", b'{"status": null}'])
def test_malformed_problem_becomes_an_error(body: bytes) -> None:
    answer = 422, {"Content-Type": "application/problem+json"}, body
    with (
        scripted_server(lambda n: answer) as (url, _),
        Client(url) as client,
        pytest.raises(ServiceError) as caught,
    ):
        client.recover("c")
    assert caught.value.status == 422


def test_computed_answers_are_waited_for_longer_than_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.client._session.SILENCE", 0.2)
    given_up = threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "layers" in self.path:
                given_up.wait(30)  # for longer than the other request waits
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"pixels")
            else:
                given_up.wait(120)

        def log_message(self, *arguments: object) -> None:
            pass

    found: list[bytes] = []
    with web_server(Slow) as url, Client(url) as patient, Client(url) as client:
        waiting = threading.Thread(target=lambda: found.append(patient.layer("m", "S.png")))
        waiting.start()
        with pytest.raises(ServiceError, match="no answer"):
            client.job("any")
        given_up.set()
        waiting.join()
    assert found == [b"pixels"]


CALLS: dict[str, Callable[[Client], object]] = {
    "job": lambda client: client.job("j"),
    "recover": lambda client: client.recover("c", quality="fast"),
    "cancel": lambda client: client.cancel("j"),
    "composite": lambda client: client.composite("m", b"backdrop"),
    "layer": lambda client: client.layer("m", "S.png"),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_safe_request_is_retried_with_the_same_key(call: Callable[[Client], object]) -> None:
    failures = {1: None, 2: refusal(503), 3: refusal(502)}
    answer = 200, {}, json.dumps(JOB).encode()  # a file or a job
    with scripted_server(lambda n: failures.get(n, answer)) as (url, calls), Client(url) as client:
        client.job("j")  # a service that has answered once is retried
        call(client)
    assert len(calls) == 5
    assert all(one == calls[1] for one in calls[2:])


def test_each_call_has_a_new_key() -> None:
    with scripted_server(lambda n: ok()) as (url, calls), Client(url) as client:
        client.recover("c")
        client.recover("c")
    assert len({call["Idempotency-Key"] for call in calls}) == 2


def test_unsafe_request_is_not_retried() -> None:
    with scripted_server(lambda n: ok() if n == 0 else None) as (url, calls), Client(url) as client:
        client.job("j")
        with pytest.raises(Unreachable):
            client._http.json("POST", "/v1/jobs/j/retry")
    assert len(calls) == 2


def test_unsafe_request_that_was_refused_is_retried() -> None:
    with scripted_server(lambda n: refusal(429) if n == 0 else ok()) as (url, calls), Client(url) as client:
        client._http.json("POST", "/v1/jobs/j/retry")
    assert len(calls) == 2


def test_pauses_grow_with_each_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(time, "sleep", waits.append)
    with scripted_server(lambda n: refusal(429) if n < 8 else ok()) as (url, _), Client(url) as client:
        client.job("j")
    for n, wait in enumerate(waits):
        longest = min(FIRST_PAUSE * 2**n, LONGEST_PAUSE)
        assert longest / 2 <= wait <= longest
    assert len(waits) == 8


@pytest.mark.parametrize("status", [429, 503])
@pytest.mark.parametrize("after", ["1", "date"])
def test_retry_waits_as_long_as_retry_after_says(status: int, after: str) -> None:
    def answer(n: int) -> Answer:
        header = formatdate(time.time() + 2, usegmt=True) if after == "date" else after
        return refusal(status, **{"Retry-After": header}) if n == 0 else ok()

    begun = time.monotonic()
    with scripted_server(answer) as (url, calls), Client(url) as client:
        assert client.recover("c").id == "j"
    assert len(calls) == 2
    assert time.monotonic() - begun >= 1  # a date has whole seconds


def test_long_retry_after_is_an_error_at_once() -> None:
    with (
        scripted_server(lambda n: refusal(429, **{"Retry-After": "3600"})) as (url, calls),
        Client(url) as client,
        pytest.raises(Busy) as caught,
    ):
        client.job("j")
    assert (len(calls), caught.value.retry_after, caught.value.status) == (1, 3600, 429)


@pytest.mark.parametrize(
    ("kind", "body"),
    [("text/html", b"<html>"), ("application/json", b'{"id": 1}'), ("application/json", b"[]")],
)
@pytest.mark.parametrize(
    "call",
    [
        lambda client, _: client.job("j"),
        lambda client, _: list(client.captures()),
        lambda client, _: list(client.mattes()),
        lambda client, _: client.share("m"),
        lambda client, _: client.composite("m", b"backdrop"),
        lambda client, _: client.layer("m", "alpha.png"),
        lambda client, file: client.export("m", file),
        lambda client, file: client.video("j", io.BytesIO()),
    ],
)
def test_another_web_server_is_recognised(
    call: Callable[[Client, Path], object], kind: str, body: bytes, tmp_path: Path
) -> None:
    file = tmp_path / "made.zip"
    with (
        scripted_server(lambda n: (200, {"Content-Type": kind}, body)) as (url, _),
        Client(url) as client,
        pytest.raises(ServiceError, match="does not answer like an envmatte service"),
    ):
        call(client, file)
    assert not file.exists()


def test_redirect_says_where_it_leads() -> None:
    answer = 301, {"Location": "https://glass.example/v1/jobs/j"}, b""
    with (
        scripted_server(lambda n: answer) as (url, calls),
        Client(url) as client,
        pytest.raises(ServiceError, match=r"301 .* leads to https://glass\.example/v1/jobs/j"),
    ):
        client.job("j")
    assert len(calls) == 1


def test_tls_to_a_service_of_plain_http_says_which_url_to_give() -> None:
    with (
        scripted_server(lambda n: ok()) as (url, _),
        Client(url.replace("http://", "https://")) as client,
        pytest.raises(Unreachable, match=r"give its URL with http://$"),
    ):
        client.job("j")


@pytest.mark.parametrize("proxy", ["http://127.0.0.1:9", "socks://127.0.0.1:9", "nonsense:proxy"])
def test_service_on_loopback_is_reached_without_a_proxy(monkeypatch: pytest.MonkeyPatch, proxy: str) -> None:
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, proxy)
    with scripted_server(lambda n: ok()) as (url, _), Client(url) as client:
        assert client.job("j").id == "j"


def test_service_elsewhere_is_reached_by_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    with scripted_server(lambda n: ok()) as (proxy, calls):
        monkeypatch.setenv("HTTP_PROXY", proxy)
        with Client("http://glass.example") as client:
            assert client.job("j").id == "j"
    assert calls[0]["call"] == "GET http://glass.example/v1/jobs/j"


@pytest.mark.parametrize("proxy", ["socks://127.0.0.1:9", "socks5://127.0.0.1:9", "nonsense:proxy"])
def test_proxy_that_is_no_http_proxy_is_named(monkeypatch: pytest.MonkeyPatch, proxy: str) -> None:
    monkeypatch.setenv("ALL_PROXY", proxy)
    with pytest.raises(ValueError, match=r"HTTPS_PROXY and ALL_PROXY .* unset"):
        Client("https://glass.example")


@pytest.mark.parametrize("path", ["", "/", "/v1", "/v1/"])
def test_url_of_the_service_or_of_its_api_is_given(path: str) -> None:
    answer = 200, {}, json.dumps(JOB).encode()
    with scripted_server(lambda n: answer) as (url, calls), Client(url + path) as client:
        client.job("j")
    assert calls[0]["call"] == "GET /v1/jobs/j"


@pytest.mark.parametrize("url", ["localhost:8000", "ftp://x", "http://", ""])
def test_invalid_url_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="http://HOST:PORT"):
        Client(url)
