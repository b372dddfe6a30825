"""The address at which other devices reach the service, such as a phone that follows the playback of a program."""

import socket

from fastapi import Request
from pydantic import BaseModel, Field

from services.api.auth import is_open
from services.api.context import OwnerContext
from services.api.http.router import Router
from services.runtime.addresses import is_loopback

router = Router(tags=["system"])
ELSEWHERE = "192.0.2.1", 9
"""An address reserved for documentation (RFC 5737). Routing to it reveals this machine's own; nothing is sent."""
ANY = ("0.0.0.0", "::")


class Network(BaseModel):
    """The address of the service for devices on the same network."""

    url: str | None = Field(description="URL of the web app; null if other devices can't reach it.")
    problem: str | None = Field(description="Why they can't, and what to do, in words.")


@router.get("/network")
def get_network(context: OwnerContext, request: Request) -> Network:
    """The address of the web app for other devices on the local network, or why there is none."""
    host = context.settings.host
    if is_loopback(host):
        engine = request.app.state.context.engine  # the caller's own engine can't read keys
        key = "make a key with `envmatte keys make NAME`, and " if is_open(context.settings, engine) else ""
        return Network(
            url=None,
            problem=f"The service listens on {host} only, where no other device can reach it: {key}start it with "
            "`envmatte serve --host 0.0.0.0`",
        )
    url = url_elsewhere(host, request)
    if url is None:
        return Network(url=None, problem="This machine is not on a network: connect it to that of the phone")
    return Network(url=url, problem=None)


def url_elsewhere(host: str, request: Request) -> str | None:
    """The address of the service for devices on the same network, if it has one.

    Parameters
    ----------
    host : str
        That the service listens on.
    request : Request
        Any to this service, which tells the port.
    """
    own = _own_address() if host in ANY else host
    if own is None or is_loopback(own):
        return None
    return f"http://{f'[{own}]' if ':' in own else own}:{request.scope['server'][1]}"


def _own_address() -> str | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
        except OSError:
            return None
        return str(probe.getsockname()[0])
