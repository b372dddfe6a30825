"""Commands for mattes: interrupts, and backdrops that are clips, stills or pipes."""

import json
import os
import tempfile
import threading
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from tests.services.cli.commands import COMMAND, interrupted
from tests.services.client.servers import JOB, ok, scripted_server, web_server

MATTE = {
    "id": "m",
    "state": "ready",
    "created_at": "",
    "capture": None,
    "job": None,
    "options": {},
    "width": 1,
    "height": 1,
    "monitor": [1, 1],
}


def test_exit_code_130_and_no_files_after_interrupted_layers(tmp_path: Path) -> None:
    arrived, finished = threading.Event(), threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "layers/rho" in self.path:  # the fourth of six
                arrived.set()
                finished.wait(60)
                return
            body = b"pixels" if "layers" in self.path else json.dumps(MATTE).encode()
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
    ("start", "command", "output"),
    [
        (b"\x89PNG\r\n\x1a\n", ["composite", "m"], "out.png"),
        (b"\0\0\0\x18ftypisom", ["composite", "m"], "out.mp4"),
        (b"PK\3\4", ["import"], None),
    ],
    ids=["picture", "clip", "matte"],
)
def test_files_may_be_pipes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: bytes, command: list[str], output: str | None
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    sent = start + bytes(100_000)
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(sent), daemon=True)
    writer.start()
    done = json.dumps(JOB | MATTE | {"state": "succeeded"}).encode()
    with scripted_server(lambda n: (200, {}, done)) as (url, calls):
        written = ["-o", str(tmp_path / output)] if output else []
        result = CliRunner().invoke(main, [*command, str(tmp_path / "pipe"), *written, "--url", url])
        writer.join(60)
    assert result.exit_code == 0, result.output
    assert calls[0]["body"] == sent
    assert not list(temporary.iterdir())
