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

from services.runtime.problems import (
    MEDIA_TYPE,
    Unauthorized,
    _problem,
    problem_of,
)
from storage.errors import (
    EnvmatteError,
    TooMany,
    Unavailable,
)

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


HEADERS: dict[type[EnvmatteError], dict[str, str]] = {
    Unauthorized: {"WWW-Authenticate": "Bearer"},
    Unavailable: {"Retry-After": "2"},  # seconds
    TooMany: {"Retry-After": "10"},
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
