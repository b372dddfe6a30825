"""Signatures of webhooks, against the specification's own example and its library."""

import base64
import time

import pytest
from standardwebhooks import Webhook, WebhookVerificationError

from services.runtime.webhook_signature import headers_of, signing_key
from services.settings import Settings

PLAIN = "a secret of sixteen and more"
ENCODED = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"


def test_signature_is_the_one_of_the_specification() -> None:
    headers = headers_of(
        signing_key(ENCODED), "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, b'{"test": 2432232314}'
    )
    assert headers == {
        "webhook-id": "msg_p5jXN8AQM9LWM0D4loKWxJek",
        "webhook-timestamp": "1614265330",
        "webhook-signature": "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=",
    }


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [(ENCODED, ENCODED), (PLAIN, f"whsec_{base64.b64encode(PLAIN.encode()).decode()}")],
    ids=["encoded", "plain"],
)
def test_library_verifies_signature(ours: str, theirs: str) -> None:
    body = '{"name":"Gläser"}'.encode()
    headers = headers_of(signing_key(ours), "id", int(time.time()), body)
    assert Webhook(theirs).verify(body, headers) == {"name": "Gläser"}
    with pytest.raises(WebhookVerificationError):
        Webhook(theirs).verify(body + b" ", headers)
    with pytest.raises(WebhookVerificationError):
        Webhook(theirs).verify(body, headers | {"webhook-id": "other"})


def test_plain_secret_is_its_utf_8_bytes() -> None:
    assert signing_key("ein Schlüssel, 16 +") == "ein Schlüssel, 16 +".encode()


def test_padding_of_base64_may_be_left_out() -> None:
    assert signing_key("whsec_c2l4dGVlbiBieXRlcyAuLg==") == b"sixteen bytes .."
    assert signing_key("whsec_c2l4dGVlbiBieXRlcyAuLg") == b"sixteen bytes .."


@pytest.mark.parametrize(
    ("secret", "reason"),
    [
        ("whsec_not Base64 at all!", "must be Base64 after whsec_"),
        ("whsec_c2hvcnQga2V5", "16 bytes"),
        ("too short", "16"),
    ],
)
def test_bad_secret_is_refused_at_start(secret: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Settings(_env_file=None, webhook_secret=secret)
