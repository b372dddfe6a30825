"""Users of a service, each a thread that runs until the end, and their requests; `users` has their actions.

All requests are HTTP on loopback and name their expected statuses. 404 and 409 are always allowed: things expire, are
deleted and end at any time.
"""

import base64
import io
import random
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import numpy as np

from services.client import Client
from tests.end_to_end.conftest import png
from tests.parts.captures import nested_program
from tests.workflows.composite.video.test_steps import clip, even, pictures
from workflows.images import float_formats
from workflows.images.integer_formats import encode_jpeg
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

ZIP = {"Content-Type": "application/zip"}
TUS = {"Tus-Resumable": "1.0.0"}
CHUNK = TUS | {"Content-Type": "application/offset+octet-stream"}
VIDEO = {"Content-Type": "video/mp4"}
ALWAYS_ALLOWED = (404, 409)
"""Statuses that are always allowed: a thing may have expired or been deleted a moment ago."""


class Traffic:
    """Users of a service.

    Parameters
    ----------
    url : str
        Of the service.
    webhook : str
        A URL for webhooks.
    folder : Path
        For files to send.
    actions : sequence of callable
        Actions that each user repeats, called with the user.
    pause : float
        Mean number of seconds between two actions of a user.
    seed : int

    Attributes
    ----------
    done : Counter
        What was done, and how often.
    wrong : list of str
        Unexpected responses.
    gentle : bool
        Whether to leave the workers alive from now on: no running job is cancelled.
    """

    def __init__(
        self, url: str, webhook: str, folder: Path, actions: "Sequence[Action]", *, pause: float, seed: int
    ) -> None:
        self.url, self.webhook, self.folder, self.pause = url, webhook, folder, pause
        self.done: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.gentle = False
        self.captures: deque[str] = deque(maxlen=12)
        self.mattes: deque[str] = deque(maxlen=12)
        self.stopped = threading.Event()
        target = io.BytesIO()
        program = nested_program(bands=((8, 6, 12), (16, 12, 8)), levels=3)
        write_capture(glass_ball.glass_ball(36, 24, rays=4), program, target, name="a ball")
        self.capture_archive = target.getvalue()
        light = glass_ball.backdrop(64, 48)
        self.backdrops = (
            png(light, "srgb", np.uint8),
            png(light, "srgb", np.uint16),
            encode_jpeg((np.clip(light, 0, 1) * 255).astype(np.uint8), 90),
            float_formats.encode_exr("RGB", light),
        )
        self.clip = clip(pictures(6), even(6))
        self._threads = [
            threading.Thread(
                target=self._repeat, args=(User(self, f"{seed} {n}"), action), name=action.__name__
            )
            for n, action in enumerate(actions)
        ]

    def __enter__(self) -> "Traffic":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stopped.set()
        for thread in self._threads:
            thread.join()

    def _repeat(self, user: "User", action: "Action") -> None:
        with user:
            while not self.stopped.wait(user.random.uniform(0, 2 * self.pause)):
                try:
                    action(user)
                except Exception as error:
                    self.wrong.append(f"{action.__name__}: {error!r}")


class User:
    """A user with a connection to the service."""

    def __init__(self, traffic: Traffic, seed: str) -> None:
        self.traffic = traffic
        self.random = random.Random(seed)
        self.client = Client(traffic.url)
        self.http = httpx2.Client(base_url=traffic.url, timeout=120)

    def __enter__(self) -> "User":
        return self

    def __exit__(self, *exception: object) -> None:
        self.http.close()
        self.client.__exit__(None, None, None)

    def ask(self, what: str, method: str, path: str, *expected: int, **request: Any) -> httpx2.Response:
        """Send a request, and record an unexpected response."""
        answer = self.http.request(method, path, **request)
        self.note(what, answer, expected)
        return answer

    def note(self, what: str, answer: httpx2.Response, expected: Sequence[int] = ()) -> None:
        """Record an action, and an unexpected response."""
        self.traffic.done[what] += 1
        if answer.status_code not in (*(expected or (200, 201, 202, 204)), *ALWAYS_ALLOWED):
            self.traffic.wrong.append(f"{what}: {answer.status_code} {answer.text[:300]}")

    def pick(self, found: Sequence[str]) -> str:
        """One of those that existed recently."""
        return self.random.choice(list(found) or ["none-yet"])

    def ended(self, job: str) -> dict[str, Any]:
        """Poll a job until it has ended or is gone."""
        while True:
            answer = self.ask("poll", "GET", f"/v1/jobs/{job}")
            found: dict[str, Any] = answer.json()
            if answer.status_code == 404 or found["state"] not in ("queued", "running"):
                return found
            time.sleep(0.2)

    def followed(self, job: str, limit: int = 1000) -> None:
        """Follow a job's events to the end, or disconnect after some."""
        with self.http.stream("GET", f"/v1/jobs/{job}/events") as answer:
            if answer.status_code != 200:
                answer.read()
            self.note("follow a job", answer)
            for n, _ in enumerate(answer.iter_lines()):
                if n >= limit:
                    return

    def disconnect(self, what: str, method: str, path: str, headers: dict[str, str], body: bytes) -> None:
        """Begin a request, then disconnect."""
        where = urlsplit(self.traffic.url)
        head = [
            f"{method} {path} HTTP/1.1",
            "Host: localhost",
            *(f"{name}: {text}" for name, text in headers.items()),
        ]
        with socket.create_connection((where.hostname, where.port), timeout=60) as line:
            line.sendall("\r\n".join([*head, "", ""]).encode() + body)
            time.sleep(self.random.uniform(0, 0.2))
        self.traffic.done[what] += 1

    def upload(self, data: bytes, **metadata: str) -> str:
        """Send bytes in pieces, with a pause between them; returns the upload's id."""
        metadata = ",".join(
            f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in metadata.items()
        )
        create = TUS | {"Upload-Length": str(len(data)), "Upload-Metadata": metadata}
        where = self.ask("create an upload", "POST", "/v1/uploads", headers=create).headers["location"]
        step = len(data) // self.random.randint(1, 4) + 1
        for at in range(0, len(data), step):
            piece = CHUNK | {"Upload-Offset": str(at)}
            self.ask("send a piece", "PATCH", where, headers=piece, content=data[at : at + step])
        return str(where.rsplit("/", 1)[1])


Action = Callable[[User], None]
