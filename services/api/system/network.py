"""Under which addresses other devices reach the service: a phone that follows what the monitor shows."""

import socket

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from services.api.auth import is_open
from services.api.context import OwnerContext
from services.runtime.addresses import is_loopback

router = APIRouter(tags=["system"])
ELSEWHERE = "192.0.2.1", 9
"""An address that is nobody's (RFC 5737): the way to it starts at this machine's own address. Nothing is sent."""
ANY = ("0.0.0.0", "::")


class Network(BaseModel):
    """Where a device of the same network finds the service."""

    url: str | None = Field(description="Of the web app; null if there is none.")
    problem: str | None = Field(description="Why there is none, and what to do, in words.")


@router.get("/network")
def get_network(context: OwnerContext, request: Request) -> Network:
    """The address of the web app for other devices of the local network, or why there is none."""
    host, port = context.settings.host, request.scope["server"][1]
    if is_loopback(host):
        engine = request.app.state.context.engine  # the caller's shows no keys
        key = "make a key with `envmatte keys make NAME`, and " if is_open(context.settings, engine) else ""
        return Network(
            url=None,
            problem=f"The service listens on {host} alone, where no other device can reach it: {key}start it as "
            "`envmatte serve --host 0.0.0.0`",
        )
    if host in ANY:
        own = _own_address()
        if own is None:
            return Network(url=None, problem="This machine is on no network: connect it to the phone's")
        host = own
    return Network(url=f"http://{f'[{host}]' if ':' in host else host}:{port}", problem=None)


def _own_address() -> str | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
        except OSError:
            return None
        return str(probe.getsockname()[0])
