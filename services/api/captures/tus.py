"""Headers of tus 1.0, the protocol of resumable uploads: those of every answer, and those of requests parsed."""

import base64
import binascii
import hashlib
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated

from fastapi import Header, Request
from starlette.datastructures import Headers, MutableHeaders

from services.runtime.problems import BadHeader, ChecksumMismatch, WrongVersion
from workflows.untrusted.control_characters import CONTROL

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PATH = "/v1/uploads"
VERSION = "1.0.0"
EXTENSIONS = "creation,creation-with-upload,checksum,expiration,termination"
ALGORITHMS = ("sha1", "sha256")
CHUNK = "application/offset+octet-stream"
METADATA_BYTES = 8192
NAME_LENGTH = 200
"""Most characters of a capture's name."""
DECLARED = ("frames", "width", "height")
"""Names in Upload-Metadata for the number of frames of a capture, and for their size in pixels."""


class Protocol:
    """Middleware that adds the headers of tus to every answer below /v1/uploads, also to problems."""

    def __init__(self, app: "ASGIApp") -> None:
        self._app = app

    async def __call__(self, scope: "Scope", receive: "Receive", send: "Send") -> None:
        if scope["type"] != "http" or not scope["path"].startswith(PATH):
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: "Message") -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Tus-Resumable"] = headers["Tus-Version"] = VERSION
            await send(message)

        # For clients behind proxies that pass on only GET and POST.
        method = Headers(scope=scope).get("x-http-method-override", scope["method"])
        await self._app({**scope, "method": method.upper()}, receive, send_with_headers)


def require_version(
    tus_resumable: Annotated[str | None, Header(description="Version of tus that the client uses.")] = None,
) -> None:
    """Check that the client uses the version of tus that the service supports.

    Raises
    ------
    WrongVersion
    """
    if tus_resumable != VERSION:
        raise WrongVersion(f"send `Tus-Resumable: {VERSION}`, the version of tus that this service supports")


class Checksum:
    """The checksum that a body should have, by its ``Upload-Checksum`` header."""

    def __init__(self, algorithm: str, digest: bytes) -> None:
        self._hash = hashlib.new(algorithm, usedforsecurity=False)
        self._digest = digest
        self.update = self._hash.update

    @classmethod
    def of(cls, request: Request) -> "Checksum | None":
        """Parse the checksum of a request, None if it has none.

        Raises
        ------
        BadHeader
        """
        header = request.headers.get("upload-checksum")
        if header is None:
            return None
        algorithm, _, text = header.partition(" ")
        if algorithm not in ALGORITHMS:
            raise BadHeader(
                f"Upload-Checksum: {algorithm!r} is not supported; use {' or '.join(ALGORITHMS)}",
                field="Upload-Checksum",
            )
        return cls(algorithm, _base64(text, "Upload-Checksum"))

    def check(self) -> None:
        """Compare the checksum with the bytes that came.

        Raises
        ------
        ChecksumMismatch
        """
        if self._hash.digest() != self._digest:
            raise ChecksumMismatch(
                "the bytes that came do not match Upload-Checksum; none of them was kept, send them again"
            )


def byte_count(request: Request, name: str) -> int:
    """Parse a header that is a number of bytes.

    Raises
    ------
    BadHeader
        If it is missing, or not a number from 0 to 10**18 - 1.
    """
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise BadHeader(f"{name}: {text or 'nothing'!r} is not a number of bytes; send one", field=name)
    return int(text)


def refuse_extensions(request: Request) -> None:
    """Refuse what other extensions of tus ask for: parts to be joined, and a length that is sent later.

    Raises
    ------
    BadHeader
    """
    if "upload-concat" in request.headers:
        raise BadHeader(
            "Upload-Concat: uploads are not joined here; send all bytes to one upload, without this header",
            field="Upload-Concat",
        )
    if "upload-defer-length" in request.headers:
        raise BadHeader(
            "Upload-Defer-Length: the length is needed from the start here; send Upload-Length, without this header",
            field="Upload-Defer-Length",
        )


def metadata_of(request: Request) -> str:
    """Check the ``Upload-Metadata`` of a request, pairs of a key and a value in Base64; returns it unchanged.

    Raises
    ------
    BadHeader
    """
    text = request.headers.get("upload-metadata", "")
    if len(text) > METADATA_BYTES:
        raise BadHeader(
            f"Upload-Metadata may have at most {METADATA_BYTES} bytes",
            field="Upload-Metadata",
            limit=METADATA_BYTES,
        )
    pairs = [pair.strip().partition(" ") for pair in text.split(",")] if text else []
    for key, _, value in pairs:
        _base64(value, "Upload-Metadata")
        if not key.isascii():
            raise BadHeader(f"Upload-Metadata: {key!r} is not ASCII", field="Upload-Metadata")
    if len({key for key, _, _ in pairs} - {""}) < len(pairs):
        raise BadHeader("Upload-Metadata: a key is empty or repeated", field="Upload-Metadata")
    return text


def declared(metadata: str) -> dict[str, int]:
    """The numbers in an ``Upload-Metadata`` that `metadata_of` has checked, by those names of `DECLARED` that it has.

    Raises
    ------
    BadHeader
        If one is not a number from 0 to 10**18 - 1.
    """
    texts = {name: text for name, text in _values(metadata).items() if name in DECLARED}
    for name, text in texts.items():
        if not (text.isdigit() and len(text) <= 18):
            raise BadHeader(
                f"Upload-Metadata: {name} is {text!r}; send a number or leave it out",
                field="Upload-Metadata",
            )
    return {name: int(text) for name, text in texts.items()}


def file_name(metadata: str) -> str:
    """The ``filename`` in an ``Upload-Metadata`` that `metadata_of` has checked, without its extension, or nothing."""
    name = _values(metadata).get("filename", b"").decode(errors="replace")
    return PurePath(CONTROL.sub("", name)).stem[:NAME_LENGTH]


def _values(metadata: str) -> dict[str, bytes]:
    pairs = (pair.strip().partition(" ") for pair in metadata.split(","))
    return {key: base64.b64decode(value) for key, _, value in pairs}


def _base64(text: str, name: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise BadHeader(f"{name}: {text!r} is not Base64", field=name) from error
