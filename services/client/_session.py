"""Requests over HTTP: failures become a `ServiceError`, and requests that are safe to repeat are retried."""

import logging
import random
import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, TypeVar

import httpx2

from services.client._errors import OF_STATUS, Busy, InvalidKey, ServiceError, Unreachable, foreign

logger = logging.getLogger(__name__)

T = TypeVar("T")
Body = bytes | Callable[[], Iterable[bytes]]
PATIENCE = 120.0
"""Seconds without progress after which a request or an upload fails: long enough for a restart of the service."""
SILENCE = 60.0
"""Seconds without a byte of the answer after which the service counts as unreachable."""
COMPUTING = 600.0
"""The same for answers that the service computes before their first byte."""
SAFE = ("GET", "HEAD", "PUT", "DELETE")
"""Idempotent methods (RFC 9110, sect. 9.2.2)."""
LOOPBACK = re.compile(r"localhost|127(\.\d+){3}|::1")
"""Hosts of this machine; the client imports nothing that `services.runtime.addresses` does."""
FIRST_PAUSE, LONGEST_PAUSE = 0.1, 5.0
"""Seconds between two attempts; the pause doubles with each."""


class Session:
    """A connection to a service.

    Parameters
    ----------
    url : str
        Of the service, or of its API, which ends in ``/v1``.
    key : str, optional
        API key.

    Attributes
    ----------
    answered : bool
        Whether a request has succeeded.

    Raises
    ------
    ValueError
        If the URL is not an HTTP URL, or a proxy that the environment names can't be used.
    InvalidKey
        If the key can't be sent.
    """

    def __init__(self, url: str, key: str | None) -> None:
        if key and not (key.isascii() and key.isprintable() and key == key.strip()):
            raise InvalidKey
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        try:
            base = httpx2.URL(url.rstrip("/").removesuffix("/v1"))
        except httpx2.InvalidURL:
            base = httpx2.URL("")
        if base.scheme not in ("http", "https") or not base.host:
            raise ValueError(f"{url!r} is not the URL of a service: give it as http://HOST:PORT")
        # A proxy of the environment may be on another machine, for which loopback is itself.
        direct = base.scheme == "http" and LOOPBACK.fullmatch(base.host) is not None
        try:
            self._http = httpx2.Client(base_url=base, headers=headers, timeout=SILENCE, trust_env=not direct)
        except (ValueError, ImportError, httpx2.InvalidURL) as error:
            raise ValueError(
                "one of the proxies that HTTP_PROXY, HTTPS_PROXY and ALL_PROXY name can't be used: name an HTTP proxy, "
                f"or unset the variable ({error})"
            ) from error
        self.answered = False

    def url_of(self, path: str) -> str:
        """The whole URL of a path of the service."""
        return f"{str(self._http.base_url).rstrip('/')}{path}"

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def json(self, method: str, path: str, *, safe: bool = False, **request: Any) -> dict[str, Any]:
        """Send a request as `send` does; returns the JSON object of the answer."""
        answer = self.send(method, path, safe=safe, **request)
        found = _object(answer)
        if found is None:
            raise foreign(self._http.base_url)
        return found

    def send(self, method: str, path: str, *, safe: bool = False, **request: Any) -> httpx2.Response:
        """Send a request, and retry it if that is safe and the service is unreachable.

        Parameters
        ----------
        safe : bool
            Whether it may be repeated although neither its method nor an Idempotency-Key says so.
        **request
            As for `streamed`.
        """
        safe = safe or method in SAFE or "Idempotency-Key" in (request.get("headers") or {})
        return self.patiently(lambda: self.once(method, path, **request), safe=safe)

    def patiently(self, call: Callable[[], T], *, safe: bool = True) -> T:
        """Repeat a call until it is answered, while a service that has answered before is unreachable.

        Waits as long as the service asks. A request refused with 429 had no effect, so it is always retried.
        """
        give_up, pause = time.monotonic() + PATIENCE, FIRST_PAUSE
        while True:
            try:
                return call()
            except (Unreachable, Busy) as error:
                again = error.status == 429 or (safe and (self.answered or error.retry_after is not None))
                # Random, so that many clients do not retry at the same moment.
                wait = max(error.retry_after or 0.0, pause * random.uniform(0.5, 1))
                if not again or time.monotonic() + wait > give_up:
                    raise
                if isinstance(error, Unreachable) and pause == FIRST_PAUSE:
                    logger.warning("no answer from %s; trying again for %g s", self._http.base_url, PATIENCE)
            time.sleep(wait)
            pause = min(2 * pause, LONGEST_PAUSE)

    def once(self, method: str, path: str, **request: Any) -> httpx2.Response:
        """Send a request once, as `streamed` does, and read the answer."""
        with self.streamed(method, path, **request) as answer:
            answer.read()
        return answer

    @contextmanager
    def streamed(
        self,
        method: str,
        path: str,
        *,
        content: Body | None = None,
        computing: bool = False,
        file: bool = False,
        **request: Any,
    ) -> Iterator[httpx2.Response]:
        """An answer whose body has not been read yet; the body of an error has been.

        Parameters
        ----------
        content : bytes or callable, optional
            The body, or a function that returns its parts, so that they can be sent again.
        computing : bool
            Whether the service computes before its first byte.
        file : bool
            Whether the answer is a file, and neither a web page nor JSON, which are those of another server.
        **request
            As httpx takes them: ``params``, ``headers``, ``json``.
        """
        if computing:
            request["timeout"] = httpx2.Timeout(SILENCE, read=COMPUTING)
        if content is not None:
            request["content"] = content() if callable(content) else content
        try:
            with self._http.stream(method, path, **request) as answer:
                if not answer.is_success:
                    answer.read()
                    raise _refusal(method, answer)
                media_type = answer.headers.get("content-type", "").partition(";")[0]
                if file and media_type in ("text/html", "application/json"):
                    raise foreign(self._http.base_url)
                yield answer
                self.answered = True
        except httpx2.TransportError as error:
            url = self._http.base_url
            problem = {"title": "No answer", "status": 503}
            plain = "WRONG_VERSION_NUMBER" in str(error)  # what OpenSSL says of an answer that is no TLS
            remedy = "give its URL with http://" if plain else "is `envmatte serve` running?"
            detail = f"no answer from {url}: {error}; {remedy}"
            raise Unreachable(problem | {"detail": detail}) from error

    def header(self, answer: httpx2.Response, name: str) -> str:
        """A header that an answer must have."""
        if name not in answer.headers:
            raise foreign(self._http.base_url)
        return str(answer.headers[name])


def _object(answer: httpx2.Response) -> dict[str, Any] | None:
    """The JSON object of an answer, None if it is something else."""
    try:
        found = answer.json()
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _refusal(method: str, answer: httpx2.Response) -> ServiceError:
    kind = OF_STATUS.get(answer.status_code, ServiceError)
    retry_after = _seconds(answer.headers.get("retry-after", ""))
    if answer.headers.get("content-type", "").startswith("application/problem+json"):
        found = _object(answer)
        if found is not None:
            return kind(found | {"status": answer.status_code}, retry_after)
    # From a proxy, cut off, or in answer to HEAD.
    detail = f"{method} {answer.url} was answered with {answer.status_code} {answer.reason_phrase}"
    if answer.has_redirect_location:  # not followed: the key would go wherever it leads
        detail += f"; check the URL of the service, the answer leads to {answer.headers['Location']}"
    problem = {"title": answer.reason_phrase, "status": answer.status_code, "detail": detail}
    return kind(problem, retry_after)


def _seconds(text: str) -> float | None:
    """The seconds of a Retry-After header, which holds seconds or a date (RFC 9110, sect. 10.2.3)."""
    if text.strip().isdecimal():
        return float(text)
    try:
        then = parsedate_to_datetime(text)
    except ValueError:
        return None
    return max((then.replace(tzinfo=then.tzinfo or UTC) - datetime.now(UTC)).total_seconds(), 0.0)
