"""Security headers for browsers, and a check that no other website sends requests through them."""

from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.runtime.addresses import is_loopback
from services.runtime.problems import ForeignSite

POLICY = "default-src 'none'; img-src 'self'; media-src 'self'; frame-ancestors 'none'"
"""For everything but the pages: a picture or a video opened by itself is shown, and nothing in it runs."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class SecurityHeaders:
    """Middleware that adds `HEADERS` to every answer, except where it has the header already."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)


def require_own_site(request: Request) -> None:
    """Check that a request to a service without keys does not come from another website in a local browser.

    A service without keys trusts everyone who can reach it, and scripts of any website reach it through a browser on
    this machine. They can send requests that need no preflight. If the site's own name resolves to this machine (DNS
    rebinding), they can read the answers too.

    Raises
    ------
    ForeignSite
    """
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    own = _split(host)
    name = own[0]
    if not (is_loopback(name) or name.endswith(".localhost")):
        raise ForeignSite(
            f"a service without keys must be called as localhost or 127.0.0.1, and this request is for {host!r}: use "
            "one of them, or make a key with `envmatte keys make NAME`"
        )
    if origin is not None and _split(origin.rpartition("://")[2]) != own:
        raise ForeignSite(
            f"a service without keys refuses requests of other websites, and this one is from {origin!r}: make a key "
            "with `envmatte keys make NAME`"
        )


def _split(netloc: str) -> tuple[str, int | None]:
    """The name and the port of a host; the name is empty if the host is malformed."""
    try:
        parts = urlsplit(f"//{netloc}")
        return parts.hostname or "", parts.port
    except ValueError:
        return "", None
