"""A small synchronous client of the HTTP API."""

import base64
import hashlib
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import httpx2

Job = dict[str, Any]
TUS = {"Tus-Resumable": "1.0.0"}
LARGEST, SMALLEST = 8 << 20, 64 << 10
"""Bytes of a file that are sent at once: half as many after a fault, twice as many after a success."""
PATIENCE = 120.0
"""Seconds without progress after which an upload or a job is given up: a service may be started again meanwhile."""
SILENCE = 60.0
"""Seconds without an answer, or a byte of it, after which a service counts as gone."""
COMPUTING = 600.0
"""The same where the service computes the whole answer before its first byte."""
AWAY = (502, 503, 504)
"""Statuses of a service that is away, with a proxy before it or without."""
PASSING = (408, 409, 423, 429, 460, 500, 502, 503, 504)
"""Statuses after which an upload is tried again, from where the service says it stands."""


class ServiceError(Exception):
    """The service refused, or a job failed; ``problem`` is its problem detail (RFC 9457)."""

    def __init__(self, problem: dict[str, Any]) -> None:
        super().__init__(problem["detail"])
        self.problem = problem


class Client:
    """A connection to a service.

    Parameters
    ----------
    url : str
        Of the service, e.g. ``http://127.0.0.1:8000``.
    key : str, optional
        API key.

    Notes
    -----
    Every call raises `ServiceError` where the service answers with a problem.
    """

    def __init__(self, url: str, key: str | None = None) -> None:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx2.Client(base_url=url, headers=headers, timeout=SILENCE)
        self._answered = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def upload(
        self, file: Path, *, name: str = "", progress: Callable[[int, int], None] | None = None
    ) -> dict[str, Any]:
        """Upload a capture; returns it.

        Connections that break and services that are started again are outlived. An upload that was given up is
        gone on with by calling this again for the same file, until the service has forgotten it.

        Parameters
        ----------
        progress : callable, optional
            Told the bytes that the service has, and those there are.

        Notes
        -----
        By tus 1.0. The Idempotency-Key is made of the file's path, size and time of change, so that nothing
        about the upload has to be remembered here.
        """
        state = file.stat()
        size = state.st_size
        mark = f"{file.resolve()} {size} {state.st_mtime_ns}"
        key = hashlib.sha256(mark.encode(errors="surrogateescape")).hexdigest()
        create = TUS | {"Upload-Length": str(size), "Idempotency-Key": key}
        where, offset, step, pause = "", -1, LARGEST, 0.1
        give_up = time.monotonic() + PATIENCE

        def reached(answer: httpx2.Response) -> int:
            found = int(answer.headers["Upload-Offset"])
            if progress and size and found != offset:
                progress(found, size)
            return found

        with file.open("rb") as source:
            while True:
                try:
                    if not where:
                        where = self._send("POST", "/v1/uploads", headers=create).headers["Location"]
                    if offset < size:
                        offset = reached(self._send("HEAD", where, headers=TUS))
                    while offset < size:
                        source.seek(offset)
                        offset = reached(self._patch(where, offset, source.read(step)))
                        step, pause = min(2 * step, LARGEST), 0.1
                        give_up = time.monotonic() + PATIENCE
                    body = {"upload": where.rsplit("/", 1)[-1], "name": name}
                    return self._json("POST", "/v1/captures", json=body)
                except ServiceError as error:
                    status = error.problem["status"]
                    if status == HTTPStatus.NOT_FOUND and offset < size and where:
                        offset = (
                            size  # another who sends this file may have finished it: then there is a capture
                        )
                        continue
                    nobody = isinstance(error.__cause__, httpx2.ConnectError) and not where
                    if nobody or status not in PASSING or time.monotonic() > give_up:
                        raise
                    time.sleep(pause)
                    step, pause = max(step // 2, SMALLEST), min(2 * pause, 5)

    def _patch(self, where: str, offset: int, data: bytes) -> httpx2.Response:
        if not data:
            detail = "the file has become shorter while it was sent; upload it again"
            raise ServiceError({"title": "The file has changed", "status": 400, "detail": detail})
        digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
        headers = TUS | {
            "Content-Type": "application/offset+octet-stream",
            "Upload-Offset": str(offset),
            "Upload-Checksum": f"sha256 {digest}",
        }
        return self._send("PATCH", where, headers=headers, content=data)

    def recover(self, capture: str, **options: Any) -> Job:
        """Queue the recovery of a matte; returns its job."""
        key = {"Idempotency-Key": secrets.token_hex(16)}
        body = {"capture": capture, "options": options}
        return self._patiently("POST", "/v1/jobs", json=body, headers=key)

    def job(self, job: str) -> Job:
        """A job."""
        return self._patiently("GET", f"/v1/jobs/{job}")

    def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return self._json("POST", f"/v1/jobs/{job}/cancel")

    def wait(self, job: str, *, progress: Callable[[Job], None] | None = None, poll: float = 0.2) -> Job:
        """Wait until a job has ended; raises `ServiceError` unless it succeeded.

        A service that is started again meanwhile is outlived.

        Parameters
        ----------
        progress : callable, optional
            Told the job at every look.
        poll : float
            Seconds between two looks, to begin with; a job that takes long is looked at once a second.
        """
        begun = time.monotonic()
        while True:
            found = self.job(job)
            if progress:
                progress(found)
            if found["state"] == "succeeded":
                return found
            if found["state"] in ("failed", "cancelled"):
                detail = f"job {job} was cancelled"
                raise ServiceError(
                    found["problem"] or {"title": "Cancelled", "status": 409, "detail": detail}
                )
            time.sleep(max(poll, min((time.monotonic() - begun) / 20, 1.0)))

    def capture(self, capture: str) -> dict[str, Any]:
        """A capture."""
        return self._json("GET", f"/v1/captures/{capture}")

    def matte(self, matte: str) -> dict[str, Any]:
        """A matte."""
        return self._json("GET", f"/v1/mattes/{matte}")

    def composite(
        self, matte: str, backdrop: bytes, *, kind: str = "image/png", **wanted: str | float
    ) -> bytes:
        """Put a matte before a backdrop; returns the picture's bytes.

        Parameters
        ----------
        backdrop : bytes
            Of an image: PNG, JPEG, TIFF or EXR.
        kind : str
            ``image/png``, ``image/jpeg`` or ``image/x-exr``.
        **wanted
            What else the call takes: ``transfer``, ``x``, ``y``, ``width``, ``height``, ``size``, ``scale`` and so on.
        """
        headers = {"Accept": kind}
        path = f"/v1/mattes/{matte}/composite"
        return self._computed("POST", path, params=wanted, content=backdrop, headers=headers)

    def composite_clip(self, matte: str, clip: Path, **wanted: str | float) -> Job:
        """Queue the composite of a clip, a video file; returns its job, which `video` gets the result of.

        Parameters
        ----------
        **wanted
            ``transfer``, ``right``, ``down``, ``scale`` and ``angle``, as the call takes them.
        """
        headers = {"Content-Type": "video/*", "Idempotency-Key": secrets.token_hex(16)}
        path = f"/v1/mattes/{matte}/composite"
        with clip.open("rb") as file:
            return self._json("POST", path, params=wanted, headers=headers, content=file)

    def video(self, job: str, target: BinaryIO) -> None:
        """Write the video of a composite job, an MP4, to a file, some megabytes at a time."""
        at, size = 0, 1
        while at < size:
            asked = {"Range": f"bytes={at}-{at + LARGEST - 1}"}
            answer = self._send("GET", f"/v1/jobs/{job}/video.mp4", headers=asked)
            at += target.write(answer.content)
            size = int(answer.headers.get("Content-Range", f"/{at}").rpartition("/")[2])

    def layer(self, matte: str, name: str) -> bytes:
        """A layer of a matte, as `confidence.png`."""
        return self._computed("GET", f"/v1/mattes/{matte}/layers/{name}")

    def export(self, matte: str, file: Path, *, progress: Callable[[int, int], None] | None = None) -> None:
        """Write a matte's archive to a file, whole or not at all.

        Parameters
        ----------
        progress : callable, optional
            Told the bytes that have come, and those there are.
        """
        part = file.with_name(file.name + ".part")
        try:
            with self._streamed("GET", f"/v1/mattes/{matte}/archive") as answer, part.open("wb") as out:
                size = int(answer.headers["Content-Length"])
                for data in answer.iter_bytes():
                    out.write(data)
                    if progress:
                        progress(out.tell(), size)
            os.replace(part, file)
        finally:
            part.unlink(missing_ok=True)

    def import_matte(
        self, file: Path, *, progress: Callable[[int, int], None] | None = None
    ) -> dict[str, Any]:
        """Make a matte of an archive; returns it.

        Parameters
        ----------
        progress : callable, optional
            Told the bytes that were sent, and those there are; the service checks them after the last.
        """
        size = file.stat().st_size

        def body(source: BinaryIO) -> Iterator[bytes]:
            while data := source.read(SMALLEST):
                yield data
                if progress:
                    progress(source.tell(), size)

        headers = {"Content-Type": "application/zip", "Content-Length": str(size)}
        with file.open("rb") as source:
            waits = httpx2.Timeout(SILENCE, read=COMPUTING)
            return self._json("POST", "/v1/mattes", headers=headers, content=body(source), timeout=waits)

    def _computed(self, method: str, path: str, **request: Any) -> bytes:
        return self._send(method, path, timeout=httpx2.Timeout(SILENCE, read=COMPUTING), **request).content

    def _json(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        found: dict[str, Any] = self._send(method, path, **request).json()
        return found

    def _patiently(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        """What may be asked again, asked again for as long as a service that was there is away."""
        give_up, pause = time.monotonic() + PATIENCE, 0.1
        while True:
            try:
                return self._json(method, path, **request)
            except ServiceError as error:
                away = error.problem["status"] in AWAY and self._answered
                if not away or time.monotonic() > give_up:
                    raise
            time.sleep(pause)
            pause = min(2 * pause, 5)

    def _send(self, method: str, path: str, **request: Any) -> httpx2.Response:
        with self._streamed(method, path, **request) as answer:
            answer.read()
        return answer

    @contextmanager
    def _streamed(self, method: str, path: str, **request: Any) -> Iterator[httpx2.Response]:
        """An answer whose body has yet to be read; that of a refusal is."""
        try:
            with self._http.stream(method, path, **request) as answer:
                if not answer.is_success:
                    answer.read()
                    raise _refusal(method, answer)
                yield answer
                self._answered = True
        except httpx2.TransportError as error:
            url = self._http.base_url
            raise ServiceError(
                {
                    "title": "No answer",
                    "status": 503,
                    "detail": f"no answer from {url}: {error}; is `envmatte serve` running?",
                }
            ) from error


def _refusal(method: str, answer: httpx2.Response) -> ServiceError:
    if answer.headers.get("content-type") == "application/problem+json" and answer.content:
        return ServiceError(answer.json())
    # Of a proxy between, or to HEAD.
    return ServiceError(
        {
            "title": answer.reason_phrase,
            "status": answer.status_code,
            "detail": f"{method} {answer.url} was answered with {answer.status_code} {answer.reason_phrase}",
        }
    )
