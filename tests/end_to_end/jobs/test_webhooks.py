"""Webhooks of a real service, to a receiver on loopback, which its settings allow."""

import base64
from pathlib import Path

import pytest
from standardwebhooks import Webhook

from services.client import NotFound, ServiceError
from tests.end_to_end.conftest import Service, serving
from tests.parts.waiting import until
from tests.services.webhooks.receivers import receiver

SECRET = "a secret of sixteen and more"
ALLOWED = {"ENVMATTE_WEBHOOK_SECRET": SECRET, "ENVMATTE_WEBHOOK_PRIVATE": "true"}


def verified(received: tuple[dict[str, str], bytes]) -> dict:
    """The JSON of a webhook, verified as a receiver would."""
    headers, body = received
    secret = f"whsec_{base64.b64encode(SECRET.encode()).decode()}"
    message = Webhook(secret).verify(body, headers)
    assert headers["Content-Type"] == "application/json"
    assert message["id"] == headers["webhook-id"]
    return dict(message)


def lines(service: Service, job: str) -> list[str]:
    log = service.http.get(f"/v1/jobs/{job}/log").json()["lines"]
    return [line["text"] for line in log if "webhook" in line["text"]]


@pytest.mark.slow
def test_failed_delivery_is_repeated_after_a_kill_and_signed(capture_archive: Path, tmp_path: Path) -> None:
    with receiver(lambda n: 500 if n == 0 else 200) as found:
        with serving(tmp_path / "data", "--workers", "1", **ALLOWED) as first:
            capture = first.client.upload(capture_archive, name="ball", webhook=found.url)
            until(lambda: len(found.received) >= 1)
            event = verified(found.received[0])
            assert (event["event"], event["job"]["id"]) == ("job.succeeded", capture.job)
            until(lambda: lines(first, capture.job))
            assert lines(first, capture.job) == ["webhook, attempt 1: answered with 500; again in 5 s"]
            first.kill()
        assert len(found.received) == 1
        with serving(tmp_path / "data", "--workers", "1", **ALLOWED) as second:
            until(lambda: len(found.received) >= 2)
            assert found.received[1][1] == found.received[0][1]
            verified(found.received[1])
            until(lambda: len(lines(second, capture.job)) == 2)
            assert lines(second, capture.job)[1] == "webhook, attempt 2: answered with 200"
            # Cancelled jobs are delivered too, even if their row is deleted before.
            job = second.client.recover(capture, webhook=found.url)
            second.client.cancel(job)
            second.client.delete(job)
            until(lambda: len(found.received) >= 3)
            event = verified(found.received[2])
            assert (event["event"], event["job"]["id"]) == ("job.cancelled", job.id)
            with pytest.raises(NotFound):
                second.client.job(job)
    assert len(found.received) == 3


def test_webhooks_need_a_secret(service: Service, capture: str) -> None:
    with pytest.raises(ServiceError, match="ENVMATTE_WEBHOOK_SECRET"):
        service.client.recover(capture, webhook="https://example.com/")
