"""Signatures of webhooks, by the specification Standard Webhooks (https://www.standardwebhooks.com)."""

import base64
import binascii
import hashlib
import hmac

PREFIX = "whsec_"
LEAST_BYTES = 16
"""Of a key."""


def signing_key(secret: str) -> bytes:
    """The key that a secret stands for.

    A secret that starts with ``whsec_`` is decoded as Base64 from there on. The key of any other secret is its UTF-8
    bytes; a library that verifies webhooks takes it as ``whsec_`` and the Base64 of those bytes.

    Raises
    ------
    ValueError
        If what follows ``whsec_`` is not Base64, or the key has less than 16 bytes.

    Examples
    --------
    >>> signing_key("whsec_c2l4dGVlbiBieXRlcyAuLg==")
    b'sixteen bytes ..'
    >>> signing_key("a secret in words")
    b'a secret in words'
    """
    key = secret.encode()
    if secret.startswith(PREFIX):
        try:
            encoded = key[len(PREFIX) :]
            padding = b"=" * (-len(encoded) % 4)  # it may be left out
            key = base64.b64decode(encoded + padding, validate=True)
        except binascii.Error as error:
            raise ValueError(f"must be Base64 after {PREFIX}") from error
    if len(key) < LEAST_BYTES:
        raise ValueError(f"must stand for a key of {LEAST_BYTES} bytes or more")
    return key


def headers_of(key: bytes, delivery: str, at: int, body: bytes) -> dict[str, str]:
    """The headers by which a receiver recognises and verifies a webhook.

    Parameters
    ----------
    key : bytes
        As `signing_key` returns it.
    delivery : str
        Id of the delivery, the same in each attempt.
    at : int
        Time of the attempt, in seconds since 1970. Receivers refuse old ones, so that nobody can replay a delivery.

    Notes
    -----
    The signature is ``v1,`` and the Base64 of the HMAC-SHA256 of id, time and body, joined by full stops.
    """
    signed = f"{delivery}.{at}.".encode() + body
    digest = hmac.digest(key, signed, hashlib.sha256)
    return {
        "webhook-id": delivery,
        "webhook-timestamp": str(at),
        "webhook-signature": f"v1,{base64.b64encode(digest).decode()}",
    }
