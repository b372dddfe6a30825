"""Requests to URLs that strangers name: to public addresses alone, unless the settings allow others."""

import http.client
import ipaddress
import re
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import SplitResult, urlsplit

from storage.errors import OptionError

LONGEST_URL = 2000
CONNECTING, SECONDS = 5.0, 15.0
"""Seconds for which an address is tried, and in which a whole request has to be answered."""
EMBEDDING = (ipaddress.IPv6Network("64:ff9b::/96"), ipaddress.IPv6Network("::/96"))
"""Where an IPv4 address is the last 32 bits: NAT64 (RFC 6052), and as compatible as they once were (RFC 4291)."""
LOCAL = (ipaddress.IPv6Network("64:ff9b:1::/48"), ipaddress.IPv6Network("100::/64"))
"""Not for the world (RFC 8215, RFC 6666), which not every Python knows."""


class Refused(OSError):
    """An address that no request may go to."""


def is_public(address: str) -> bool:
    """Whether an address is one of the whole internet: not private, loopback, link-local, multicast, reserved.

    An IPv6 address that stands for one of IPv4 (mapped, 6to4, NAT64) is as public as that.
    """
    ip = ipaddress.ip_address(address)
    if isinstance(ip, ipaddress.IPv6Address):
        embedded = ip.ipv4_mapped or ip.sixtofour
        if embedded is None and any(ip in network for network in EMBEDDING):
            embedded = ipaddress.IPv4Address(int(ip) & 0xFFFFFFFF)
        if embedded is not None:
            return is_public(str(embedded))
        if ip.is_site_local or any(ip in network for network in LOCAL):
            return False
    return ip.is_global and not (ip.is_multicast or ip.is_reserved)


def check(url: str, *, private: bool) -> None:
    """See that a URL can be one that is told something.

    Parameters
    ----------
    private : bool
        Whether it may be of an address that is not public, and then without TLS.

    Raises
    ------
    OptionError
        If it can't. A name is looked up only when something is sent.
    """
    try:
        parts = _split(url)
        secure = parts.scheme == "https" or (private and parts.scheme == "http")
    except ValueError:
        secure = False
    if not secure:
        raise OptionError(
            "a webhook is https://HOST/…, of at most 2000 ASCII characters, without user, password and fragment",
            field="webhook",
        )
    host = str(parts.hostname)
    try:
        # As the C library reads numbers: 2130706433 and 0x7f.1 are 127.0.0.1.
        addresses = _addresses(host, socket.AI_NUMERICHOST)
    except OSError:
        local = host.rstrip(".").lower()
        addresses = ["127.0.0.1"] if local == "localhost" or local.endswith(".localhost") else []
    if not private and not all(map(is_public, addresses)):
        raise OptionError(
            f"the address of {host} is not public, and this service tells nothing to such; name another host, or set "
            "ENVMATTE_WEBHOOK_PRIVATE where everyone who may post jobs may reach it",
            field="webhook",
        )


def post(
    url: str, body: bytes, headers: Mapping[str, str], *, private: bool, seconds: float = SECONDS
) -> int:
    """Send a body; returns the status. Redirects are not followed, and of the answer no more than its head is read.

    Parameters
    ----------
    private : bool
        Whether the address may be one that is not public.
    seconds : float
        For all of it but looking up the name.

    Raises
    ------
    Refused
        If one of the host's addresses is not public, and may not be.
    OSError, http.client.HTTPException, ValueError
        If no answer came.

    Notes
    -----
    It connects to an address that was checked, so that a name which is looked up otherwise a moment later gains
    nothing. No proxy is asked, whatever the environment says: it would look up the name by itself.
    """
    parts = _split(url)
    host, secure = str(parts.hostname), parts.scheme == "https"
    addresses = _addresses(host)
    for address in addresses:
        if not private and not is_public(address):
            raise Refused(f"{host} is at {address}, which is not public")
    give_up = time.monotonic() + seconds
    kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
    connection = kind(host, parts.port)
    sock = _connect(addresses, connection.port, give_up)
    late = threading.Event()

    def end() -> None:  # a receiver that sends a byte now and then would never time out
        late.set()
        with suppress(OSError):
            socket.socket.shutdown(sock, socket.SHUT_RDWR)

    over = threading.Timer(give_up - time.monotonic(), end)
    try:
        if secure:
            context = ssl.create_default_context()
            sock = context.wrap_socket(sock, server_hostname=host, do_handshake_on_connect=False)
        over.start()
        if isinstance(sock, ssl.SSLSocket):
            sock.do_handshake()
        connection.sock = sock
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("POST", target, body, {**headers, "Connection": "close"})
        status = connection.getresponse().status
        if late.is_set():
            raise TimeoutError(f"no whole answer within {seconds:g} s")
        return status
    finally:
        over.cancel()
        connection.close()
        sock.close()


def _split(url: str) -> SplitResult:
    if len(url) > LONGEST_URL or not re.fullmatch(r"[!-~]+", url):
        raise ValueError("not printable ASCII, or too long")
    parts = urlsplit(url)
    unfit = parts.username is not None or parts.fragment or parts.port == 0
    if unfit or not parts.hostname or "%" in parts.hostname:  # no zone of an address either
        raise ValueError("not of the form https://HOST/…")
    parts.hostname.encode("idna")  # a ValueError where no name can be looked up so
    return parts


def _addresses(host: str, flags: int = 0) -> list[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=flags)
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


def _connect(addresses: list[str], port: int, give_up: float) -> socket.socket:
    """A connection to the first of the addresses that takes one."""
    for n, address in enumerate(addresses, 1):
        try:
            left = max(give_up - time.monotonic(), 0.1)
            sock = socket.create_connection((address, port), min(CONNECTING, left))
        except OSError:
            if n == len(addresses):
                raise
        else:
            sock.settimeout(max(give_up - time.monotonic(), 0.1))
            return sock
    raise OSError("the name has no address")
