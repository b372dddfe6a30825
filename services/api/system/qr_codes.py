"""QR codes of this service's own addresses, for phones that read them off a screen."""

import io
from typing import Annotated
from urllib.parse import urlsplit

import segno
from fastapi import Query, Request, Response

from services.api.context import PublicContext
from services.api.http.router import Router
from services.api.system.network import url_elsewhere
from storage.errors import InvalidInput

page = Router(tags=["system"])
SVG = "image/svg+xml"
# The same text always gives the same picture, which runs and loads nothing.
HEADERS = {"Cache-Control": "public, max-age=86400", "Content-Security-Policy": "default-src 'none'"}


@page.get(
    "/qr.svg", response_class=Response, responses={200: {"content": {SVG: {}}, "description": "The code"}}
)
def get_qr_code(
    context: PublicContext,
    request: Request,
    text: Annotated[str, Query(max_length=200, description="An address of this service.")],
) -> Response:
    """An address of this service as a QR code. As it holds no data it needs no key, so pages can show it."""
    if not _is_own(text, context.settings.host, request):
        raise InvalidInput(
            f"QR codes are made for addresses of this service, such as {request.base_url}, and not for others",
            field="text",
        )
    picture = io.BytesIO()
    code = segno.make_qr(text, error="m")
    code.save(picture, kind="svg", light="#fff", xmldecl=False, svgclass=None, lineclass=None, omitsize=True)
    return Response(picture.getvalue(), headers=HEADERS, media_type=SVG)


def _is_own(address: str, host: str, request: Request) -> bool:
    """Whether it leads to this service, as the browser that asks reaches it, or other devices do."""
    try:
        parts = urlsplit(address)
    except ValueError:
        return False
    elsewhere = urlsplit(url_elsewhere(host, request) or "")
    # A proxy may speak HTTPS with the browser, and HTTP with the service.
    return parts.scheme in ("http", "https") and parts.netloc.lower() in (
        request.url.netloc.lower(),
        *filter(None, (elsewhere.netloc,)),
    )
