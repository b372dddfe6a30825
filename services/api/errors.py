"""From errors to HTTP: the only table, and the only shape (RFC 9457)."""

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match, Route

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
PROBLEM: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "A problem (RFC 9457)",
        "content": {
            MEDIA_TYPE: {
                "schema": {
                    "type": "object",
                    "required": ["type", "title", "status", "detail"],
                    "properties": {
                        "type": {"type": "string", "format": "uri"},
                        "title": {"type": "string"},
                        "status": {"type": "integer"},
                        "detail": {"type": "string"},
                        "entry": {"type": "string"},
                        "field": {"type": "string"},
                        "name": {"type": "string", "description": "Of a limit, as `GET /v1/limits` has it."},
                        "limit": {"type": "number"},
                        "value": {"type": "number", "description": "What would have to be within it."},
                    },
                }
            }
        },
    }
}
logger = logging.getLogger(__name__)


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

HEADERS: dict[type[EnvmatteError], dict[str, str]] = {
    Unauthorized: {"WWW-Authenticate": "Bearer"},
    Unavailable: {"Retry-After": "2"},  # seconds
    TooMany: {"Retry-After": "10"},
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


def answer(problem: dict[str, Any], headers: dict[str, str] | None = None) -> JSONResponse:
    """A problem detail as a response."""
    return JSONResponse(problem, problem["status"], headers, media_type=MEDIA_TYPE)


def register(app: FastAPI) -> None:
    """Give every error of an app this shape, those of the framework included."""

    @app.exception_handler(EnvmatteError)
    async def _ours(request: Request, error: EnvmatteError) -> JSONResponse:
        return answer(problem_of(error), HEADERS.get(type(error)))

    @app.exception_handler(HTTPException)
    async def _framework(request: Request, error: HTTPException) -> JSONResponse:
        status = HTTPStatus(error.status_code)
        slug = status.phrase.lower().replace(" ", "-")
        detail = f"{request.method} {request.url.path}: {str(error.detail).lower()}; see GET /openapi.json"
        headers = dict(error.headers or {})
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(sorted(_methods(request)))
        return answer(_problem(status, slug, status.phrase, detail), headers)

    @app.exception_handler(RequestValidationError)
    async def _validation(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"][1:])
        problem = _problem(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            "bad-request",
            "The request can't be used",
            f"{field or first['loc'][0]}: {first['msg']}",
            field=field,
        )
        return answer(problem)

    @app.exception_handler(ClientDisconnect)
    async def _nobody_there(request: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=HTTPStatus.REQUEST_TIMEOUT)  # which nobody reads

    @app.exception_handler(Exception)
    async def _unforeseen(request: Request, error: Exception) -> JSONResponse:
        logger.error("%s %s", request.method, request.url.path, exc_info=error)
        return answer(problem_of(error))


def _methods(request: Request) -> set[str]:
    """What can be done with a path, by all of its routes: the framework tells only what the first of them does."""
    matching = [
        r for r in request.app.routes if isinstance(r, Route) and r.matches(request.scope)[0] != Match.NONE
    ]
    return {method for route in matching for method in route.methods or ()}
