"""Commands for mattes: interrupts, and backdrops that are clips, stills or pipes."""

import json
import os
import threading
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from tests.services.cli.commands import COMMAND, interrupted
from tests.services.client.servers import ok, scripted_server, web_server


def test_exit_code_130_and_no_files_after_interrupted_layers(tmp_path: Path) -> None:
    arrived, finished = threading.Event(), threading.Event()
    matte = {"id": "m", "state": "ready", "created_at": "", "capture": None, "job": None, "options": {}}
    matte |= {"width": 1, "height": 1, "monitor": [1, 1]}

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "layers/rho" in self.path:  # the fourth of six
                arrived.set()
                finished.wait(60)
                return
            body = b"pixels" if "layers" in self.path else json.dumps(matte).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments: object) -> None:
            pass

    with web_server(Slow) as url:
        command = [*COMMAND, "layers", "m", str(tmp_path / "out"), "--url", url]
        code, stderr = interrupted(command, arrived)
        finished.set()
    assert (code, list(tmp_path.iterdir())) == (130, [])
    assert stderr.endswith("Interrupted.\n")


def test_exit_code_130_and_a_cancelled_job_after_an_interrupted_clip(tmp_path: Path) -> None:
    arrived = threading.Event()

    def answer(n: int):  # type: ignore[no-untyped-def]
        if n == 3:
            arrived.set()
        return ok()

    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"\0\0\0\x18ftypisom" + bytes(100))
    with scripted_server(answer) as (url, calls):
        output = tmp_path / "out.mp4"
        code, _ = interrupted(
            [*COMMAND, "composite", "m", str(clip), "-o", str(output), "--url", url], arrived
        )
    assert code == 130
    assert calls[-1]["call"] == "POST /v1/jobs/j/cancel"
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"\0\0\0\x18ftypisom", "clip"),
        (b"\0\0\0\x08wide\0\0\0\0", "clip"),
        (b"\x1aE\xdf\xa3", "clip"),
        (b"RIFF\0\0\0\0AVI LIST", "clip"),
        (b"\x47\x40\0\x10" + bytes(184) + b"\x47", "clip"),
        (b"\0\0\0\0\x47\x40\0\x10" + bytes(188) + b"\x47", "clip"),
        (b"\0\0\0\x18ftypheic", "still"),
        (b"\0\0\0\x18ftypcrx ", "still"),
        (b"\x89PNG\r\n\x1a\n", "still"),
        (b"GIF89a", "still"),
        (b"GIF89a" + bytes(182) + b"\x47", "still"),
        (b"RIFF\0\0\0\0WEBP", "still"),
        (b"", "still"),
    ],
)
def test_clips_and_stills_differ_by_their_first_bytes(tmp_path: Path, start: bytes, kind: str) -> None:
    file = tmp_path / "backdrop"
    file.write_bytes(start + bytes(300 if start else 0))
    output = tmp_path / "out.txt"
    answer = CliRunner().invoke(main, ["composite", "m", str(file), "-o", str(output)])
    assert answer.exit_code == 2
    assert ("must end in .mp4" in " ".join(answer.output.split())) == (kind == "clip")


@pytest.mark.parametrize(
    ("start", "code"), [(b"\x89PNG\r\n\x1a\n", 0), (b"\0\0\0\x18ftypisom", 2)], ids=["picture", "clip"]
)
def test_a_backdrop_from_a_pipe(tmp_path: Path, start: bytes, code: int) -> None:
    sent = start + bytes(300)
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(sent), daemon=True)
    writer.start()
    with scripted_server(lambda n: (200, {}, b"a composite")) as (url, calls):
        output = tmp_path / "out.png"
        command = ["composite", "m", str(tmp_path / "pipe"), "-o", str(output), "--url", url]
        done = CliRunner().invoke(main, command)
        writer.join(60)
    assert done.exit_code == code, done.output
    if code:
        assert "save it to a file" in done.stderr
    else:
        assert [call["body"] for call in calls] == [sent]
