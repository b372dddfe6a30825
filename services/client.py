"""A small synchronous client of the HTTP API."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx2

Job = dict[str, Any]
PART = 1 << 20


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
        self._http = httpx2.Client(base_url=url, headers=headers, timeout=60)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def upload(
        self, file: Path, *, name: str = "", progress: Callable[[int, int], None] | None = None
    ) -> dict[str, Any]:
        """Upload a capture, streamed; returns it. ``progress`` is told the bytes sent and those there are."""
        size = file.stat().st_size

        def parts() -> Iterator[bytes]:
            sent = 0
            with file.open("rb") as source:
                while part := source.read(PART):
                    yield part
                    sent += len(part)
                    if progress:
                        progress(sent, size)

        headers = {"Content-Type": "application/zip", "Content-Length": str(size)}
        return self._json("POST", "/v1/captures", params={"name": name}, content=parts(), headers=headers)

    def recover(self, capture: str, **options: Any) -> Job:
        """Queue the recovery of a matte; returns its job."""
        return self._json("POST", "/v1/jobs", json={"capture": capture, "options": options})

    def job(self, job: str) -> Job:
        """A job."""
        return self._json("GET", f"/v1/jobs/{job}")

    def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return self._json("POST", f"/v1/jobs/{job}/cancel")

    def wait(self, job: str, *, progress: Callable[[Job], None] | None = None, poll: float = 0.2) -> Job:
        """Wait until a job has ended; raises `ServiceError` unless it succeeded.

        Parameters
        ----------
        progress : callable, optional
            Told the job at every look.
        poll : float
            Seconds between two looks.
        """
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
            time.sleep(poll)

    def capture(self, capture: str) -> dict[str, Any]:
        """A capture."""
        return self._json("GET", f"/v1/captures/{capture}")

    def matte(self, matte: str) -> dict[str, Any]:
        """A matte."""
        return self._json("GET", f"/v1/mattes/{matte}")

    def composite(self, matte: str, backdrop: bytes, *, transfer: str = "srgb") -> bytes:
        """Put a matte before a backdrop, the bytes of an image; returns those of a PNG."""
        answer = self._send(
            "POST", f"/v1/mattes/{matte}/composite", params={"transfer": transfer}, content=backdrop
        )
        return answer.content

    def layer(self, matte: str, name: str) -> bytes:
        """A layer of a matte, as `confidence.png`."""
        return self._send("GET", f"/v1/mattes/{matte}/layers/{name}").content

    def _json(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        found: dict[str, Any] = self._send(method, path, **request).json()
        return found

    def _send(self, method: str, path: str, **request: Any) -> httpx2.Response:
        try:
            answer = self._http.request(method, path, **request)
        except httpx2.TransportError as error:
            url = self._http.base_url
            raise ServiceError(
                {
                    "title": "No answer",
                    "status": 503,
                    "detail": f"no answer from {url}: {error}; is `envmatte serve` running?",
                }
            ) from error
        if answer.is_success:
            return answer
        raise ServiceError(answer.json())
