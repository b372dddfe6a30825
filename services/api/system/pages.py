"""Pages for browsers: the web app at `/`, the API's documentation at `/docs`, and their files below `/web`."""

import base64
import hashlib
import os
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse, HTMLResponse, Response
from starlette.datastructures import Headers
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Receive, Scope, Send

from services.api.http.media_types import preferred
from services.api.system.minified import TYPES, minified, minified_file

page = APIRouter()
WEB = Path(__file__).parents[2] / "web"
"""Files for browsers."""
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
"""Pages may load and fetch only from this service, and show pictures and videos that they make (`blob:`)."""
# Browsers ask again each time, and get a 304: after an upgrade old files never mix with new ones.
FRESH = {"Cache-Control": "no-cache"}
COMPRESSED_TYPES = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "text/plain")
"""The media types of what is compressed already; the samples' mattes, whose suffix has none, count as text."""


class Files(StaticFiles):
    """Static files that browsers revalidate each time."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        return _revalidated(super().file_response(*args, **options))


class MinifiedFiles(Files):
    """Static files that are sent without comments and spaces."""

    def file_response(
        self,
        full_path: str | os.PathLike[str],
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        path = Path(full_path)
        if path.suffix not in TYPES:
            return super().file_response(full_path, stat_result, scope, status_code)
        content, tag = minified_file(path, stat_result.st_mtime)
        answer = Response(content, status_code, {"ETag": tag}, TYPES[path.suffix])
        if self.is_not_modified(answer.headers, Headers(scope=scope)):
            answer = NotModifiedResponse(answer.headers)
        return _revalidated(answer)


def _revalidated(answer: Response) -> Response:
    """A file that browsers ask for again each time.

    Its tag is weak, because it is the same whether the file is compressed or not (RFC 9110, sect. 8.8.3.3).
    """
    answer.headers.update({**FRESH, "ETag": f"W/{answer.headers['ETag']}"})
    return answer


class Compressed(GZipMiddleware):
    """Static files, compressed on their way: all of the app takes a third of its bytes then."""

    def __init__(self, files: StaticFiles) -> None:
        super().__init__(files, compresslevel=6, exclude_content_types=COMPRESSED_TYPES)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # Starlette takes gzip;q=0, which refuses it (RFC 9110, sect. 12.5.3), for a wish, and GZIP for none.
        coding = preferred(Headers(scope=scope).get("accept-encoding", ""), ["gzip"]) or "identity"
        headers = [(name, value) for name, value in scope["headers"] if name != b"accept-encoding"]
        headers.append((b"accept-encoding", coding.encode()))
        await super().__call__({**scope, "headers": headers}, receive, send)


def _app() -> str:
    """The app's page, with a link for each module: browsers then load all of them at once, not one after another.

    Words are left out: the app loads those of one language.
    """
    modules = sorted(path.relative_to(WEB).as_posix() for path in (WEB / "app").rglob("*.js"))
    links = "\n".join(
        f'<link rel="modulepreload" href="web/{module}">'
        for module in modules
        if module != "app/main.js" and not module.startswith("app/words/")
    )
    page = (WEB / "app" / "index.html").read_text(encoding="utf-8").replace("<!-- preload -->", links)
    return minified(page, "text/html")


def _app_policy() -> str:
    """`POLICY` with the app's one inline script, by its hash: it must run although no file of the app comes."""
    script = re.search(r"<script>(.*?)</script>", APP, re.DOTALL)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    return POLICY.replace("script-src 'self'", f"script-src 'self' 'sha256-{digest}'")


APP = _app()
HEADERS = {**FRESH, "Content-Security-Policy": _app_policy()}
SWAGGER = Path(str(files("fastapi_offline"))) / "static"
"""Swagger UI, served from here: FastAPI's own page would load it from another host."""
# Its style sheet embeds pictures.
DOCS = {**FRESH, "Content-Security-Policy": POLICY.replace("img-src 'self'", "img-src 'self' data:")}


@page.get("/", include_in_schema=False, response_class=HTMLResponse)
async def get_app() -> HTMLResponse:
    """The web app. The page itself needs no key: it asks the user for one if the API needs it."""
    return HTMLResponse(APP, headers=HEADERS)


@page.get("/docs", include_in_schema=False, response_class=FileResponse)
async def get_docs() -> FileResponse:
    """The API's documentation, in Swagger UI."""
    return FileResponse(WEB / "docs" / "index.html", media_type="text/html", headers=DOCS)
