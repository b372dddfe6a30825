"""Whole HTTP/1.1 requests as bytes, to a service with a matte, a video and an upload."""

import asyncio
import tempfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import unquote

import h11

from services.api.app import build_app
from services.settings import Settings
from storage.database.engine import open_engine, writing
from storage.layout import composites
from storage.objects.store import Objects
from storage.records import jobs, mattes, programs, tiles, uploads
from tests.fuzzing import changes, seeds
from tests.fuzzing.campaign import KEPT, Refused
from tests.workflows.mattes.imports.conftest import make_matte
from workflows.images.integer_formats import encode_png
from workflows.kernels import use_matte

SPECIAL = (
    *(
        "",
        " ",
        ",",
        ";",
        "=",
        "/",
        "%",
        "%00",
        "%ff",
        "%ed%a0%80",
        "\x00",
        "\x7f",
        "\xe9",
        "\u0663",
        "\ud800",
        "..",
        "*",
    ),
    *(
        "-1",
        "0",
        "00",
        "1e999",
        "nan",
        "inf",
        "-inf",
        "1_0",
        "+1",
        "9" * 19,
        "9" * 30,
        "9" * 5000,
        "A" * 300,
        "true",
        "null",
    ),
)
PNG = encode_png(seeds.PIXELS)
JSON = ("POST /v1/jobs", "POST /v1/captures", "POST /v1/programs", "PUT /v1/programs/PROGRAM/showing")
BODIES: dict[str, dict[str, Any]] = {
    JSON[0]: {"capture": "c", "options": {"method": "lobes", "tile": 64}, "webhook": "https://example.org/"},
    JSON[1]: {"upload": "u", "name": "é", "webhook": "https://example.org/"},
    JSON[2]: {
        "program": {**seeds.MANIFEST["program"], "parts": seeds.MANIFEST["program"]["parts"][:5]},
        "monitor": {"width": 640, "height": 480},
        "border": False,
    },
    JSON[3]: {
        "phase": "showing",
        "patterns_per_second": 2.0,
        "seconds": 1.5,
        "shown": 3,
        "border": {"width": 640, "height": 480},
    },
}
LINES = (
    "GET /v1/jobs?limit=10&after=v&state=succeeded",
    "GET /v1/jobs/v",
    "GET /v1/jobs/v/log?limit=10&after=3",
    "GET /v1/jobs/v/events",
    "GET /v1/jobs/v/video.mp4",
    "POST /v1/jobs/v/retry",
    "POST /v1/jobs/v/cancel",
    "GET /v1/captures?limit=10&after=c&state=ready",
    "GET /v1/captures/c/frames/3.png",
    "GET /v1/mattes?limit=10",
    "GET /v1/mattes/m",
    "GET /v1/mattes/m/layers/alpha.png?lobes=2",
    "GET /v1/mattes/m/layers/all.exr?lobes=2",
    "GET /v1/mattes/m/transport?x=3&y=4&lobes=2",
    "POST /v1/mattes/m/composite?transfer=srgb&x=1&y=2&width=8&height=8&size=6&quality=90",
    "POST /v1/mattes/m/composite?right=0.1&down=-0.2&scale=1.5&angle=30",
    "POST /v1/mattes/m/composite?depth=3&distance=2&camera=5",
    "POST /v1/mattes/m/composite?depth=3&distance=2&other=m&other_distance=4",
    "POST /v1/uploads",
    "PATCH /v1/uploads/u",
    "HEAD /v1/uploads/u",
    "OPTIONS /v1/uploads",
    "GET /v1/programs?limit=3",
    "GET /v1/programs/PROGRAM",
    "GET /v1/programs/PROGRAM/patterns/2.png",
    "GET /v1/presets",
    "GET /v1/limits",
    "GET /v1/capture.schema.json",
    "GET /v1/network",
    "GET /web/app.js",
    "GET /openapi.json?x",
)
HEADERS = (
    "Idempotency-Key: abc",
    "Upload-Length: 100",
    "Upload-Offset: 0",
    "Upload-Checksum: sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
    "Upload-Metadata: filename YS56aXA=,is_confidential,name w6k=",
    "Content-Type: application/offset+octet-stream; charset=utf-8",
    "Content-Type: application/json",
    "Content-Type: video/mp4",
    "Content-Type: application/zip",
    "Tus-Resumable: 1.0.0",
    "X-HTTP-Method-Override: PATCH",
    "Range: bytes=10-20",
    "Range: bytes=-5",
    'If-None-Match: "abc", W/"d", *',
    "Accept: image/png;q=0.5, image/x-exr;q=0.9, */*;q=0.1",
    "traceparent: 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
    "Last-Event-ID: 0123456789abcdef",
    "Authorization: Bearer key",
    "If-Modified-Since: Sun, 06 Nov 1994 08:49:37 GMT",
)


def compile_kernels() -> tuple[str]:
    """Compile the kernels that requests call, which takes longer and more memory than a request may."""
    with tempfile.TemporaryDirectory() as folder:
        use_matte(Objects(Path(folder).as_uri()))
    return ("compiled",)


def other_text(random: Random, text: str) -> str:
    """A line of text with some words, numbers or characters replaced."""
    for _ in range(random.choice((0, 1, 1, 2, 4))):
        at = random.randrange(len(text) + 1)
        to = at
        while to < len(text) and text[to].isalnum():
            to += 1
        what = random.randrange(4)
        if what == 0:
            text = text[:at] + random.choice(SPECIAL) + text[at:]
        elif what == 1:
            text = text[:at] + random.choice(SPECIAL) + text[to:]
        elif what == 2:
            text = text[:at] + text[at + random.choice((1, 1, 5)) :]
        else:
            text = text[:at] + text[at : at + 12] * random.choice((2, 2, 30)) + text[at:]
    return text


def make(random: Random, valid: object) -> bytes:
    """A request with correct framing and something else wrong."""
    headers = random.sample(HEADERS, random.randrange(4))
    if random.random() < 0.4:
        line = random.choice(JSON)
        body = changes.other_json(random, BODIES[line])
        headers.append("Content-Type: application/json")
    else:
        line = random.choice(LINES)
        body = b""
        if "composite" in line:
            body = PNG if random.random() < 0.8 else changes.damaged_png(random, PNG)
        elif "/uploads" in line:
            body = random.choice((b"", b"x" * 10))
            headers += [*random.sample(HEADERS[1:6], 3), "Tus-Resumable: 1.0.0"]
    method, path = line.split(" ", 1)
    changed = random.randrange(3)
    if changed != 0:
        path = other_text(random, path)
    if changed != 1:
        headers = [other_text(random, header) for header in headers]
    head = [f"{method} {path} HTTP/1.1", "Host: localhost", f"Content-Length: {len(body)}", *headers, "", ""]
    return "\r\n".join(head).encode("latin-1", "replace") + body


class Served:
    """The service's application on a folder, without a cluster."""

    def __init__(self, folder: Path) -> None:
        settings = Settings(data=folder, webhook_secret="0123456789abcdef", upload_bytes=1 << 20)
        engine, objects = open_engine(f"sqlite:///{folder}/envmatte.db"), Objects((folder / "store").as_uri())
        matte = make_matte(objects)
        with writing(engine) as c:
            mattes.add_imported(c, "m", matte.attributes["options"], matte.figures, 1000, None)
            jobs.add(c, "composite", "", {}, "m", job="v", stored=1000)
            tiles.add_steps(c, "v")
            jobs.log(c, "v", "a line")
            jobs.end(c, "v", "succeeded")
            self.program = programs.add(c, BODIES[JSON[2]]["program"])
            uploads.add(c, "u", 100, "", 1e6, None)
        objects.put(composites.video_path("v"), bytes(1000))
        compile_kernels()  # loads them
        self.app = build_app(settings, engine, objects)
        self.loop = asyncio.new_event_loop()
        self._engine = engine

    def close(self) -> None:
        self.app.state.context.decoders.close()
        self._engine.dispose()
        self.loop.close()


@cache
def served(folder: Path) -> Served:
    folder.mkdir(exist_ok=True)
    return Served(folder)


def read(data: bytes, folder: Path) -> None:
    """Answer a request as the web server does; every error must be a 4xx problem."""
    service = served(folder / KEPT)
    connection = h11.Connection(h11.SERVER)
    connection.receive_data(data.replace(b"PROGRAM", service.program.encode()))
    body = b""
    try:
        request = connection.next_event()
        while not isinstance(event := connection.next_event(), h11.EndOfMessage):
            if event in (h11.NEED_DATA, h11.PAUSED):
                raise Refused  # bodies that never end are tested elsewhere
            body += bytes(event.data)
    except h11.RemoteProtocolError as error:
        raise Refused from error
    path, _, query = request.target.partition(b"?")
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "server": ("127.0.0.1", 8000),
        "client": ("127.0.0.1", 1),
        "scheme": "http",
        "root_path": "",
        "method": request.method.decode(),
        "path": unquote(path.decode()),
        "raw_path": path,
        "query_string": query,
        "headers": [(name.lower(), value) for name, value in request.headers],
    }
    sent: list[dict[str, Any]] = []
    messages = iter([{"type": "http.request", "body": body, "more_body": False}])

    async def receive() -> dict[str, Any]:
        message = next(messages, None)
        if message is None:
            await asyncio.sleep(5)  # and hangs up
            return {"type": "http.disconnect"}
        return message

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    service.loop.run_until_complete(service.app(scope, receive, send))
    status, headers = sent[0]["status"], dict(sent[0]["headers"])
    answer = h11.Response(status_code=status, headers=[*headers.items()])  # raises if it cannot be sent
    assert answer.status_code < 500 or answer.status_code == 507, sent
    if status >= 400:
        assert headers[b"content-type"] == b"application/problem+json", sent
        raise Refused
