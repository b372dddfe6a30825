"""What browsers are told with every answer, and what the websites of others may not ask through them."""

from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.runtime.addresses import is_loopback
from services.runtime.problems import ForeignSite

POLICY = "default-src 'none'; img-src 'self'; media-src 'self'; frame-ancestors 'none'"
"""Of what is no page of ours: a picture or a video opened by itself shows, and nothing in it runs."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Careful:
    """An app all of whose answers have `HEADERS`, where they have no such ones of their own."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, tell)


def see_that_no_site_asks(request: Request) -> None:
    """See that it is not a website of others that asks, in the browser of someone on this machine.

    A service without keys trusts whoever can reach it, and from there a site's scripts can: they may send what needs no
    leave of ours; and under a name of the site's that leads to this machine (DNS rebinding) they read answers too.

    Raises
    ------
    ForeignSite
    """
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    called = _split(host)
    name = called[0]
    if not (is_loopback(name) or name.endswith(".localhost")):
        raise ForeignSite(
            f"a service without keys is asked as localhost or 127.0.0.1, and this was asked as {host!r}: ask it so, or "
            "make a key with `envmatte keys make NAME`"
        )
    if origin is not None and _split(origin.rpartition("://")[2]) != called:
        raise ForeignSite(
            f"a service without keys takes nothing from other websites, and this is from {origin!r}: make a key with "
            "`envmatte keys make NAME`"
        )


def _split(netloc: str) -> tuple[str, int | None]:
    """The name and the port of a host, the name empty if it is none."""
    try:
        parts = urlsplit(f"//{netloc}")
        return parts.hostname or "", parts.port
    except ValueError:
        return "", None
