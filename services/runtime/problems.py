"""From errors to problem details (RFC 9457): the only table."""

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


class TooLarge(InvalidInput):
    """A body of more bytes than are taken."""


class WrongMediaType(InvalidInput):
    """A body of another media type than is taken."""


class NotAcceptable(InvalidInput):
    """An answer asked for in a media type that can't be given."""


class NotNeeded(InvalidInput):
    """An answer that the caller has already, as its If-None-Match says."""


class BadHeader(InvalidInput):
    """A header that is missing, or does not say what it should."""


class WrongVersion(InvalidInput):
    """A version of the protocol of uploads that is not spoken."""


class ChecksumMismatch(InvalidInput):
    """A body that is not what its checksum was made of."""


class Unauthorized(EnvmatteError):
    """No key, or one that is not known."""


class Forbidden(EnvmatteError):
    """A key that does not allow this."""


class ForeignSite(EnvmatteError):
    """Asked for by a website of others, of a service without keys."""


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
    BadHeader: (HTTPStatus.BAD_REQUEST, "bad-header", "A header can't be used"),
    WrongVersion: (HTTPStatus.PRECONDITION_FAILED, "wrong-version", "Another version is spoken here"),
    ChecksumMismatch: (460, "checksum-mismatch", "Not what the checksum was made of"),  # of tus
    InvalidInput: (HTTPStatus.UNPROCESSABLE_ENTITY, "bad-request", "The request can't be used"),
    Unauthorized: (HTTPStatus.UNAUTHORIZED, "unauthorized", "A key is needed"),
    Forbidden: (HTTPStatus.FORBIDDEN, "forbidden", "The key does not allow this"),
    ForeignSite: (HTTPStatus.FORBIDDEN, "foreign-site", "Not for other websites"),
    NotFound: (HTTPStatus.NOT_FOUND, "not-found", "Not found"),
    Conflict: (HTTPStatus.CONFLICT, "conflict", "Not in this state"),
    NoRoom: (HTTPStatus.INSUFFICIENT_STORAGE, "no-room", "There is no room for it"),
    TooMany: (HTTPStatus.TOO_MANY_REQUESTS, "too-many", "Too many at once"),
    Unavailable: (HTTPStatus.SERVICE_UNAVAILABLE, "unavailable", "Out of reach for now"),
    Corrupt: (HTTPStatus.INTERNAL_SERVER_ERROR, "corrupt", "Stored data is missing or damaged"),
    GaveUp: (HTTPStatus.INTERNAL_SERVER_ERROR, "gave-up", "The work failed again and again"),
    Exception: (HTTPStatus.INTERNAL_SERVER_ERROR, "internal", "Something went wrong here"),
}


def problem_of(error: Exception) -> dict[str, Any]:
    """The problem detail of an error: ``type``, ``title``, ``status``, ``detail``, and what locates the fault."""
    kind = next(kind for kind in type(error).__mro__ if kind in PROBLEMS)
    status, slug, title = PROBLEMS[kind]
    if isinstance(error, EnvmatteError):
        return _problem(status, slug, title, error.detail, **error.fields)
    # What an unforeseen error says is for the log: it may name what is no caller's business.
    return _problem(status, slug, title, f"an unforeseen {type(error).__name__}; the service's log has more")


def _problem(status: int, slug: str, title: str, detail: str, **fields: Any) -> dict[str, Any]:
    return {
        "type": f"urn:envmatte:problem:{slug}",
        "title": title,
        "status": int(status),
        "detail": detail,
        **fields,
    }
