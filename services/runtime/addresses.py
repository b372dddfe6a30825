"""Addresses of this machine: loopback ones, and those that a process listens on."""

import errno
import ipaddress
import socket

from storage.errors import Conflict


class PortTaken(Conflict):
    """Another process listens there; `envmatte` exits with a code of its own."""


def is_loopback(host: str) -> bool:
    """Whether an address or a host name is loopback, which only this machine can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bind(host: str, port: int) -> socket.socket:
    """A TCP socket at an address and a port, 0 for a free one; it does not listen yet.

    Raises
    ------
    PortTaken
        If another process listens there.
    Conflict
        If this machine does not have the address, this user may not have the port, or the host has characters that no
        name has.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol left out, asyncio would not set TCP_NODELAY on the connections: then the body of an answer
    # waits 40 ms for the acknowledgement of its head.
    bound = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise cannot_listen(host, port, error) from error
    except TypeError as error:
        bound.close()
        raise Conflict(f"can't listen on {host!r}: this is not a host name") from error
    return bound


def cannot_listen(host: str, port: int, error: OSError) -> Conflict:
    """The error for an address and a port that a process can't listen on."""
    if error.errno == errno.EADDRINUSE:
        return PortTaken(
            f"another process listens on port {port} of {host} already: stop it, or choose another port with --port; 0 "
            "takes a free one"
        )
    return Conflict(f"can't listen on {host}, port {port}: {error.strerror}")


def url_of(host: str, port: int) -> str:
    """The URL of an HTTP server at an address and a port (RFC 3986, section 3.2.2)."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
