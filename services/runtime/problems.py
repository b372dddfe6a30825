"""Problem details (RFC 9457): the status, slug and title of each error, for answers and for failed jobs."""

from http import HTTPStatus
from typing import Any

from storage.errors import (
    ArchiveError,
    CaptureError,
    ClipError,
    Conflict,
    Corrupt,
    EnvmatteError,
    GaveUp,
    ImageError,
    InvalidInput,
    NoRoom,
    NotFound,
    OptionError,
    OverLimit,
    TooMany,
    Unavailable,
)

MEDIA_TYPE = "application/problem+json"
CAPTURE_SCHEMA = "/v1/capture.schema.json"


class TooLarge(InvalidInput):
    """A body with more bytes than the limit."""


class WrongMediaType(InvalidInput):
    """A body of another media type than the route takes."""


class CodedBody(WrongMediaType):
    """A body with a content coding, such as gzip."""


class NotAcceptable(InvalidInput):
    """An Accept header without any media type that the route can answer in."""


class NotNeeded(InvalidInput):
    """A request for what the caller already has, by its If-None-Match."""


class BadHeader(InvalidInput):
    """A header that is missing or malformed."""


class BadRange(InvalidInput):
    """A Range header that asks for no byte of what there is."""


class WrongVersion(InvalidInput):
    """Another version of the upload protocol than the service speaks."""


class ChecksumMismatch(InvalidInput):
    """A body that does not match its checksum."""


class Unauthorized(EnvmatteError):
    """No key, or an unknown one."""


class Forbidden(EnvmatteError):
    """A key whose scope does not allow the request."""


class ForeignSite(EnvmatteError):
    """A request by another website, to a service without keys."""


PROBLEMS: dict[type[Exception], tuple[int, str, str]] = {
    OverLimit: (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too-large", "Too large"),
    CaptureError: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-capture", "The capture can't be used"),
    ArchiveError: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-archive", "The archive can't be used"),
    ImageError: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-image", "The image can't be used"),
    ClipError: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-clip", "The clip can't be used"),
    OptionError: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-option", "The options can't be used"),
    TooLarge: (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too-large", "Too large"),
    WrongMediaType: (HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "wrong-media-type", "Wrong media type"),
    NotAcceptable: (HTTPStatus.NOT_ACCEPTABLE, "not-acceptable", "Not acceptable"),
    NotNeeded: (HTTPStatus.PRECONDITION_FAILED, "not-needed", "Not needed"),
    BadHeader: (HTTPStatus.BAD_REQUEST, "bad-header", "Bad header"),
    BadRange: (HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, "bad-range", "No such bytes"),
    WrongVersion: (HTTPStatus.PRECONDITION_FAILED, "wrong-version", "Wrong protocol version"),
    ChecksumMismatch: (460, "checksum-mismatch", "Checksum mismatch"),  # the status is of tus
    InvalidInput: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-request", "The request can't be used"),
    Unauthorized: (HTTPStatus.UNAUTHORIZED, "unauthorized", "Key required"),
    Forbidden: (HTTPStatus.FORBIDDEN, "forbidden", "The key does not allow this"),
    ForeignSite: (HTTPStatus.FORBIDDEN, "foreign-site", "Refused to another website"),
    NotFound: (HTTPStatus.NOT_FOUND, "not-found", "Not found"),
    Conflict: (HTTPStatus.CONFLICT, "conflict", "Not in this state"),
    NoRoom: (HTTPStatus.INSUFFICIENT_STORAGE, "no-room", "There is no room for it"),
    TooMany: (HTTPStatus.TOO_MANY_REQUESTS, "too-many", "Too many at once"),
    Unavailable: (HTTPStatus.SERVICE_UNAVAILABLE, "unavailable", "Temporarily unavailable"),
    Corrupt: (HTTPStatus.INTERNAL_SERVER_ERROR, "corrupt", "Stored data is missing or damaged"),
    GaveUp: (HTTPStatus.INTERNAL_SERVER_ERROR, "gave-up", "The work failed repeatedly"),
    Exception: (HTTPStatus.INTERNAL_SERVER_ERROR, "internal", "Internal error"),
}
"""Status, slug and title by the type of the error, or by the closest of its bases."""


def problem_of(error: Exception) -> dict[str, Any]:
    """The problem detail of an error: ``type``, ``title``, ``status``, ``detail``, and fields that locate the fault."""
    known = next(base for base in type(error).__mro__ if base in PROBLEMS)
    status, slug, title = PROBLEMS[known]
    if isinstance(error, EnvmatteError):
        detail = error.detail
        if slug == "bad-capture" and "field" in error.fields:
            detail += f"; see GET {CAPTURE_SCHEMA} for the schema of capture.json"
        return problem_detail(status, slug, title, detail, **error.fields)
    # The text of an unexpected error is for the log only: it may hold what callers must not see.
    return problem_detail(
        status, slug, title, f"unexpected {type(error).__name__}; the service's log has the details"
    )


def problem_detail(status: int, slug: str, title: str, detail: str, **fields: Any) -> dict[str, Any]:
    """A problem detail with the members of RFC 9457, and with fields of its own."""
    return {
        "type": f"urn:envmatte:problem:{slug}",
        "title": title,
        "status": int(status),
        "detail": detail,
        **fields,
    }
