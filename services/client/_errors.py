"""Errors of the client; `services.client` draws the tree."""

from typing import Any


class ServiceError(Exception):
    """The service refused, could not be reached, or a job did not succeed.

    Attributes
    ----------
    problem : dict
        The problem detail (RFC 9457): ``type`` (unless the client or a proxy made it), ``title``, ``status``,
        ``detail``, and what locates the fault: ``entry``, ``field``, ``limit``.
    status : int
        HTTP status.
    retry_after : float or None
        Seconds after which the service asks for a retry, if it does.
    """

    def __init__(self, problem: dict[str, Any], retry_after: float | None = None) -> None:
        super().__init__(problem.get("detail") or problem.get("title") or str(problem))
        self.problem = problem
        self.status = int(problem.get("status", 0))
        self.retry_after = retry_after


class Unreachable(ServiceError):
    """The service did not answer, in spite of retries."""


class Busy(ServiceError):
    """Too many requests, or temporarily unavailable (429, 502, 503, 504): try again later."""


class NotAllowed(ServiceError):
    """No key, or a key without permission (401, 403)."""


class NotFound(ServiceError):
    """No such capture, job or matte (404)."""


class FileChanged(ServiceError):
    """A file changed while it was sent."""

    def __init__(self) -> None:
        detail = "the file became shorter while it was sent; upload it again"
        super().__init__({"title": "The file has changed", "status": 400, "detail": detail})


def foreign(server: object = "the server") -> ServiceError:
    """The error for an answer that is not that of a service."""
    detail = f"{server} does not answer like an envmatte service; check the URL"
    return ServiceError({"title": "Another service", "status": 502, "detail": detail})


OF_STATUS: dict[int, type[ServiceError]] = {
    401: NotAllowed,
    403: NotAllowed,
    404: NotFound,
    429: Busy,
    502: Busy,
    503: Busy,
    504: Busy,
}


class InvalidKey(ValueError):
    """An API key that can't be sent. It is not shown: most of it may be right."""

    def __init__(self) -> None:
        super().__init__("the API key has a line break or other characters that no key has: copy it again")
