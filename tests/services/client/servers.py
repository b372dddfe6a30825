"""Web servers on loopback that answer a client as a test says."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@contextmanager
def web_server(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """Run a web server until the block ends; yields its URL."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


JOB = {
    "id": "j",
    "kind": "recover",
    "state": "running",
    "stage": "recovering",
    "progress": 0.5,
    "tiles": {"total": 2, "done": 1, "failed": 0},
    "eta_seconds": 1.5,
    "waits_for": None,
    "capture": "c",
    "matte": "m",
    "options": {},
    "problem": None,
    "created_at": "2026-01-01T00:00:00Z",
    "finished_at": None,
    "news": "of a later version",
}
Answer = tuple[int, dict[str, str], bytes] | None
"""Status, headers, body; None breaks the connection."""


@contextmanager
def scripted_server(answers: Callable[[int], Answer]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Run a web server that answers call n with ``answers(n)``; yields its URL and the calls so far."""
    calls: list[dict[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            answer = answers(len(calls))
            calls.append({"call": f"{self.command} {self.path}", "body": body, **self.headers})
            if answer is None:
                self.close_connection = True
                return
            status, headers, content = answer
            self.send_response(status)
            for name, value in ({"Content-Length": str(len(content))} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_DELETE = do

        def log_message(self, *arguments: object) -> None:
            pass

    with web_server(Handler) as url:
        yield url, calls


def ok(answer: dict[str, Any] = JOB) -> Answer:
    return 200, {"Content-Type": "application/json"}, json.dumps(answer).encode()


def refusal(status: int, detail: str = "why, and what to do", **headers: str) -> Answer:
    problem = {"type": "urn:x", "title": "t", "status": status, "detail": detail, "field": "f"}
    return status, {"Content-Type": "application/problem+json"} | headers, json.dumps(problem).encode()
