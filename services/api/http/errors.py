"""Error handlers: every error of the API is answered as a problem detail (RFC 9457)."""

import logging
from http import HTTPStatus
from typing import Any

import anyio.to_thread
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match, Mount

from services.runtime.logs import LOGGED
from services.runtime.problems import MEDIA_TYPE, CodedBody, Unauthorized, problem_detail, problem_of
from storage.errors import Corrupt, EnvmatteError, InvalidInput, StoreUnavailable, TooMany, Unavailable
from storage.objects import marker
from workflows.untrusted.validation import field_and_reason

RESPONSES: dict[int | str, dict[str, Any]] = {
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
                        "name": {"type": "string", "description": "Of a limit, as in `GET /v1/limits`."},
                        "limit": {"type": "number"},
                        "value": {"type": "number", "description": "The value that exceeds the limit."},
                    },
                }
            }
        },
    }
}
"""The answer that every route may give, for OpenAPI."""
HEADERS: dict[type[EnvmatteError], dict[str, str]] = {
    Unauthorized: {"WWW-Authenticate": "Bearer"},
    CodedBody: {"Accept-Encoding": "identity"},
    Unavailable: {"Retry-After": "2"},  # seconds
    TooMany: {"Retry-After": "10"},
}
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
logger = logging.getLogger(__name__)


def problem_response(problem: dict[str, Any], headers: dict[str, str] | None = None) -> JSONResponse:
    """A problem detail as a response."""
    return JSONResponse(problem, problem["status"], headers, media_type=MEDIA_TYPE)


def register(app: FastAPI) -> None:
    """Register handlers for every error of an app, those of the framework included."""

    @app.exception_handler(EnvmatteError)
    async def _ours(request: Request, error: EnvmatteError) -> JSONResponse:
        if isinstance(error, Corrupt):
            try:
                # In a thread: a share that hangs must not stop all other requests.
                await anyio.to_thread.run_sync(marker.require_mounted, request.app.state.context.objects)
            except StoreUnavailable as away:  # nothing is missing
                error = away
        base = next((base for base in type(error).__mro__ if base in HEADERS), type(error))
        return problem_response(problem_of(error), HEADERS.get(base))

    @app.exception_handler(HTTPException)
    async def _framework(request: Request, error: HTTPException) -> JSONResponse:
        status = HTTPStatus(error.status_code)
        slug = status.phrase.lower().replace(" ", "-")
        detail = f"{request.method} {request.url.path}: {str(error.detail).lower()}; see GET /openapi.json"
        headers = dict(error.headers or {})
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(sorted(_methods(request)))
        return problem_response(problem_detail(status, slug, status.phrase, detail), headers)

    @app.exception_handler(RequestValidationError)
    async def _validation(request: Request, error: RequestValidationError) -> JSONResponse:
        name, why = field_and_reason(error.errors())
        place, _, field = name.partition(".")  # of the request: its body, its query or its headers
        return problem_response(problem_of(InvalidInput(f"{field or place}: {why}", field=field)))

    @app.exception_handler(ClientDisconnect)
    async def _disconnected(request: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=HTTPStatus.REQUEST_TIMEOUT)  # nobody reads it

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        logger.error("%s %s", request.method, request.url.path, exc_info=error)
        setattr(error, LOGGED, True)
        # The framework raises the error again, and the server then disconnects.
        return problem_response(problem_of(error), {"Connection": "close"})


def _methods(request: Request) -> set[str]:
    """The methods of all routes of a path, those of files if there is none.

    The framework names only those of the first route that matches.
    """
    routes = [route for route in request.app.routes if not isinstance(route, Mount)]
    found = {
        method
        for method in METHODS
        if any(route.matches({**request.scope, "method": method})[0] == Match.FULL for route in routes)
    }
    return found | {"HEAD"} if "GET" in found else found or {"GET", "HEAD"}
