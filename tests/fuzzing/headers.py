"""Headers, options and URLs: how damaged ones are made, and what must hold for their values."""

import json
from collections.abc import Callable
from pathlib import Path
from random import Random

from starlette.requests import Request

from services.api.captures import tus
from services.api.http.media_types import preferred, require_media_type
from services.api.http.responses import etag_matches
from services.api.mattes.composites import clips as clips_api
from services.api.mattes.composites import composites as composites_api
from services.runtime.tracing import TRACEPARENT
from services.webhooks import safe_http
from storage.errors import InvalidInput
from tests.fuzzing import changes, requests
from tests.fuzzing.campaign import Refused
from tests.fuzzing.seeds import Files
from workflows.mattes.options import parse_options

HEADERS = (
    "Upload-Length: 100",
    "Upload-Offset: 0",
    "Upload-Checksum: sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
    "Upload-Metadata: filename YS56aXA=,is_confidential,name w6k=",
    "Content-Type: application/offset+octet-stream; charset=utf-8",
    "Tus-Resumable: 1.0.0",
    "Range: bytes=10-20",
    "Range: bytes=-5",
    'If-None-Match: "abc", W/"d", *',
    "Accept: image/png;q=0.5, image/x-exr;q=0.9, */*;q=0.1",
    "traceparent: 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
)


def make_headers(random: Random, valid: Files) -> bytes:
    lines = random.sample(HEADERS, random.randrange(1, 6))
    return "\n".join(requests.other_text(random, line) for line in lines).encode("latin-1", "replace")


def read_headers(data: bytes, folder: Path) -> None:
    pairs = [line.partition(b":")[::2] for line in data.split(b"\n")]
    headers = [(name.lower(), value.strip()) for name, value in pairs]
    request = Request({"type": "http", "method": "GET", "path": "/", "headers": headers})
    start, end = clips_api._span(request.headers.get("range", ""), 1000)
    assert start >= 0
    assert start >= 1000 or start < end <= 1000
    etag_matches(request.headers, '"abc"')
    TRACEPARENT.fullmatch(request.headers.get("traceparent", ""))
    readers: dict[str, Callable[[], object]] = {
        "upload-checksum": lambda: tus.Checksum.of(request),
        "upload-metadata": lambda: tus.metadata_of(request),
        "upload-length": lambda: tus.byte_count(request, "Upload-Length"),
        "content-type": lambda: require_media_type(request, tus.CHUNK, "the bytes of an upload"),
        "accept": lambda: preferred(request.headers["accept"], composites_api.ANSWERS),
    }
    refused = None
    for name in readers.keys() & request.headers.keys():
        try:
            readers[name]()
        except InvalidInput as error:
            refused = error
    if refused is not None:
        raise refused


OPTIONS = {
    "method": "lobes",
    "tile": 64,
    "quality": "fast",
    "most_lobes": 2,
    "resolution": 1.1,
    "doubt": 0.5,
    "least_weight": 0.001,
}


def make_options(random: Random, valid: Files) -> bytes:
    return changes.other_json(random, random.choice((OPTIONS, OPTIONS | {"method": "nn-dgsr"})))


def read_options(data: bytes, folder: Path) -> None:
    try:
        given = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Refused from error
    if not isinstance(given, dict):
        raise Refused
    options = parse_options(given)
    json.dumps(options.model_dump(mode="json"), allow_nan=False)
    assert parse_options(options.model_dump(mode="json")) == options


URLS = (
    "https://example.org/hook?a=1",
    "https://93.184.216.34:8443/",
    "http://[::ffff:127.0.0.1]:80/x",
    "https://0x7f.1/",
    "https://xn--bcher-kva.example/é",
)


def make_url(random: Random, valid: Files) -> bytes:
    return requests.other_text(random, random.choice(URLS)).encode("utf-8", "surrogatepass")


def read_url(data: bytes, folder: Path) -> None:
    safe_http.check_url(data.decode("utf-8", "replace"), private=bool(data and data[0] & 1))
