"""The pages: the web app at `/`, the API's documentation at `/docs`, and the browser's files below `/web`."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles

page = APIRouter()
WEB = Path(__file__).parents[2] / "web"
"""The browser's files."""
POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "connect-src 'self'",
        "img-src 'self' blob:",
        "media-src 'self' blob:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""What the page may do: run and fetch what this service serves, and show pictures and videos of its own (`blob:`)."""
# Asked for again each time, and answered with 304: after an upgrade no file of the old app is mixed with the new.
FRESH = {"Cache-Control": "no-cache"}


class Files(StaticFiles):
    """The browser's files."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        answer = super().file_response(*args, **options)
        answer.headers.update(FRESH)
        return answer


HEADERS: Mapping[str, str] = FRESH | {"Content-Security-Policy": POLICY}
SWAGGER = Path(str(files("fastapi_offline"))) / "static"
"""Swagger UI, which FastAPI's own page would have fetched from another host, and run among our pages."""
# Its style sheet has pictures in it.
DOCS = {**HEADERS, "Content-Security-Policy": POLICY.replace("img-src 'self'", "img-src 'self' data:")}


@page.get("/", include_in_schema=False, response_class=FileResponse)
def get_app() -> FileResponse:
    """The app. It holds nothing of the service: asked for without a key, it asks for one."""
    return FileResponse(WEB / "app" / "index.html", media_type="text/html", headers=HEADERS)


@page.get("/docs", include_in_schema=False, response_class=FileResponse)
def get_docs() -> FileResponse:
    """The API's documentation, by Swagger UI."""
    return FileResponse(WEB / "docs" / "index.html", media_type="text/html", headers=DOCS)
