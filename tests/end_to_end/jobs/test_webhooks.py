"""Webhooks of a real service, to a receiver on loopback, which its settings allow."""

import hashlib
import json
import time
from pathlib import Path

import pytest

from services.client import NotFound, ServiceError
from tests.end_to_end.conftest import Service, serving
from tests.services.webhooks.receivers import Receiver, receiver

SECRET = "a secret of sixteen and more"
ALLOWED = {"ENVMATTE_WEBHOOK_SECRET": SECRET, "ENVMATTE_WEBHOOK_PRIVATE": "true"}


def hmac_sha256(key: bytes, message: bytes) -> str:
    """As RFC 2104 has it, for keys of up to 64 bytes."""
    key = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in key) + message).digest()
    return hashlib.sha256(bytes(b ^ 0x5C for b in key) + inner).hexdigest()


def verified(came: tuple[dict[str, str], bytes]) -> dict:
    """What a receiver was told, if it is signed."""
    headers, body = came
    signed = dict(part.split("=", 1) for part in headers["Envmatte-Signature"].split(","))
    assert abs(int(signed["t"]) - time.time()) < 300
    assert signed["v1"] == hmac_sha256(SECRET.encode(), signed["t"].encode() + b"." + body)
    assert headers["Content-Type"] == "application/json"
    told = json.loads(body)
    assert told["id"] == headers["Envmatte-Delivery"]
    return dict(told)


def wait_for(found: Receiver, count: int) -> None:
    deadline = time.monotonic() + 120
    while len(found.came) < count:
        assert time.monotonic() < deadline
        found.news.wait(0.1)
        found.news.clear()


def lines(service: Service, job: str) -> list[str]:
    log = service.http.get(f"/v1/jobs/{job}/log").json()["lines"]
    return [line["text"] for line in log if "webhook" in line["text"]]


def test_what_fails_first_comes_over_a_kill_and_signed(bundle: Path, tmp_path: Path) -> None:
    with receiver(lambda n: 500 if n == 0 else 200) as found:
        with serving(tmp_path / "data", "--workers", "1", **ALLOWED) as first:
            capture = first.client.upload(bundle, name="told", webhook=found.url)
            wait_for(found, 1)
            told = verified(found.came[0])
            assert (told["event"], told["job"]["id"]) == ("job.succeeded", capture.job)
            while not lines(first, capture.job):
                time.sleep(0.05)
            assert lines(first, capture.job) == ["webhook, attempt 1: answered with 500; again in 5 s"]
            first.kill()
        assert len(found.came) == 1
        with serving(tmp_path / "data", "--workers", "1", **ALLOWED) as second:
            wait_for(found, 2)
            assert found.came[1][1] == found.came[0][1]
            verified(found.came[1])
            while len(lines(second, capture.job)) < 2:
                time.sleep(0.05)
            assert lines(second, capture.job)[1] == "webhook, attempt 2: answered with 200"
            # A cancelled job is told too, and one whose row is gone before it is.
            job = second.client.recover(capture, webhook=found.url)
            second.client.cancel(job)
            second.client.delete(job)
            wait_for(found, 3)
            told = verified(found.came[2])
            assert (told["event"], told["job"]["id"]) == ("job.cancelled", job.id)
            with pytest.raises(NotFound):
                second.client.job(job)
    assert len(found.came) == 3


@pytest.mark.exhaustive
def test_a_service_with_a_secret_refuses_addresses_that_are_not_public(bundle: Path, tmp_path: Path) -> None:
    with (
        receiver(lambda n: 200) as found,
        serving(tmp_path / "data", "--workers", "1", ENVMATTE_WEBHOOK_SECRET=SECRET) as service,
    ):
        capture = service.client.upload(bundle)
        port = found.url.split(":")[2]
        for host in ("127.0.0.1", "2130706433", "0x7f.1", "[::ffff:127.0.0.1]", "localhost"):
            with pytest.raises(ServiceError, match="not public") as caught:
                service.client.recover(capture, webhook=f"https://{host}:{port}")
            assert (caught.value.status, caught.value.problem["field"]) == (422, "webhook")
        with pytest.raises(ServiceError, match="https://HOST"):
            service.client.recover(capture, webhook=found.url)
        assert [job["kind"] for job in service.http.get("/v1/jobs").json()["jobs"]] == ["ingest"]
        assert found.came == []


def test_a_service_without_a_secret_takes_no_webhook(service: Service, capture: str) -> None:
    with pytest.raises(ServiceError, match="ENVMATTE_WEBHOOK_SECRET"):
        service.client.recover(capture, webhook="https://example.com/")
