"""Requests to URLs from untrusted callers: only to public addresses, unless the settings allow others."""

import http.client
import ipaddress
import re
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from urllib.parse import SplitResult, urlsplit

from storage.errors import OptionError

LONGEST_URL = 2000
CONNECT_SECONDS = 5.0
"""Time to connect to one address."""
SECONDS = 15.0
"""Time for a whole request and its answer."""
EMBEDDING = (ipaddress.IPv6Network("64:ff9b::/96"), ipaddress.IPv6Network("::/96"))
"""Networks whose last 32 bits are an IPv4 address: NAT64 (RFC 6052) and IPv4-compatible addresses (RFC 4291)."""
LOCAL = tuple(
    ipaddress.ip_network(network)
    for network in ("192.0.0.0/24", "192.88.99.0/24", "64:ff9b:1::/48", "100::/64", "3fff::/20")
)
"""Networks that are not public (RFC 6890, RFC 7526, RFC 8215, RFC 6666, RFC 9637); Python takes some of them for
public."""
ISATAP = (0x00005EFE, 0x02005EFE)
"""Bits 64 to 95 of IPv6 addresses whose last 32 bits are an IPv4 address (RFC 5214, section 6.1)."""


class Refused(OSError):
    """An address that requests must not go to."""


def is_public(address: str) -> bool:
    """Whether an address is public: not private, loopback, link-local, multicast or reserved.

    An IPv6 address that embeds an IPv4 address (mapped, 6to4, NAT64) is public if that address is; one that leads
    through a tunnel to an IPv4 address (ISATAP) only if both are.
    """
    ip = ipaddress.ip_address(address)
    if isinstance(ip, ipaddress.IPv6Address):
        embedded = ip.ipv4_mapped or ip.sixtofour
        last = ipaddress.IPv4Address(int(ip) & 0xFFFFFFFF)
        if embedded is None and any(ip in network for network in EMBEDDING):
            embedded = last
        if embedded is not None:
            return is_public(str(embedded))
        is_tunnel = int(ip) >> 32 & 0xFFFFFFFF in ISATAP
        if ip.is_site_local or (is_tunnel and not is_public(str(last))):
            return False
    if any(ip in network for network in LOCAL):
        return False
    return ip.is_global and not (ip.is_multicast or ip.is_reserved)


def check_url(url: str, *, private: bool) -> None:
    """Check that a URL can be a webhook. Host names are resolved only when something is sent.

    Parameters
    ----------
    private : bool
        Whether it may name an address that is not public, and may do without TLS.

    Raises
    ------
    OptionError
    """
    try:
        parts = _split(url)
        secure = parts.scheme == "https" or (private and parts.scheme == "http")
    except ValueError:
        secure = False
    if not secure:
        raise OptionError(
            "a webhook must be https://HOST/…, of at most 2000 ASCII characters, without user, password or fragment",
            field="webhook",
        )
    host = str(parts.hostname)
    try:
        # The C library reads addresses in many forms: 2130706433 and 0x7f.1 are 127.0.0.1.
        addresses = _addresses(host, socket.AI_NUMERICHOST)
    except OSError:
        local = host.rstrip(".").lower()
        addresses = ["127.0.0.1"] if local == "localhost" or local.endswith(".localhost") else []
    if not private and not all(map(is_public, addresses)):
        raise OptionError(
            f"the address of {host} is not public, and this service sends webhooks only to public addresses: use "
            "another host, or set ENVMATTE_WEBHOOK_PRIVATE if all who may post jobs may reach private addresses",
            field="webhook",
        )


def post(
    url: str, body: bytes, headers: Mapping[str, str], *, private: bool, seconds: float = SECONDS
) -> int:
    """POST a body; returns the status of the answer. Follows no redirects, and reads only the head of the answer.

    Parameters
    ----------
    private : bool
        Whether the host may have addresses that are not public.
    seconds : float
        Time limit for everything except resolving the name.

    Raises
    ------
    Refused
        If one of the host's addresses is not public and ``private`` is false.
    OSError, http.client.HTTPException, ValueError
        If there was no valid answer.

    Notes
    -----
    It connects to an address that was checked, so a name that resolves to another address a moment later (DNS
    rebinding) does not matter. It uses no proxy, whatever the environment says: a proxy would resolve the name again.
    """
    parts = _split(url)
    host, secure = str(parts.hostname), parts.scheme == "https"
    addresses = _addresses(host)
    for address in addresses:
        if not private and not is_public(address):
            raise Refused(f"{host} is at {address}, which is not public")
    deadline = time.monotonic() + seconds
    # Without a port, http.client takes the end of an IPv6 address for one.
    port = parts.port or (443 if secure else 80)
    connection = (http.client.HTTPSConnection if secure else http.client.HTTPConnection)(host, port)
    sock = _connect(addresses, port, deadline)
    try:
        if secure:
            context = ssl.create_default_context()
            sock = context.wrap_socket(sock, server_hostname=host, do_handshake_on_connect=False)
        with _shut_down_at(deadline, sock, TimeoutError(f"no complete answer within {seconds:g} s")):
            if isinstance(sock, ssl.SSLSocket):
                sock.do_handshake()
            connection.sock = sock
            target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
            connection.request("POST", target, body, {**headers, "Connection": "close"})
            return connection.getresponse().status
    finally:
        connection.close()
        sock.close()


@contextmanager
def _shut_down_at(deadline: float, sock: socket.socket, late: TimeoutError) -> Iterator[None]:
    """Shut a socket down if the block has not ended by a deadline, and raise an error then.

    The socket's own timeout starts again with every byte that comes.
    """
    timed_out = threading.Event()

    def shut_down() -> None:
        timed_out.set()
        with suppress(OSError):
            socket.socket.shutdown(sock, socket.SHUT_RDWR)

    timer = threading.Timer(deadline - time.monotonic(), shut_down)
    timer.start()
    try:
        yield
    except (OSError, http.client.HTTPException) as error:
        if timed_out.is_set():  # what else goes wrong then follows from that
            raise late from error
        raise
    finally:
        timer.cancel()
    if timed_out.is_set():
        raise late


def _split(url: str) -> SplitResult:
    if len(url) > LONGEST_URL or not re.fullmatch(r"[!-~]+", url):
        raise ValueError("not printable ASCII, or too long")
    parts = urlsplit(url)
    malformed = parts.username is not None or parts.fragment or parts.port == 0
    if malformed or not parts.hostname or "%" in parts.hostname:  # % starts the zone of an IPv6 address
        raise ValueError("not of the form https://HOST/…")
    parts.hostname.encode("idna")  # raises ValueError if the name can't be resolved
    return parts


def _addresses(host: str, flags: int = 0) -> list[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=flags)
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


def _connect(addresses: list[str], port: int, deadline: float) -> socket.socket:
    """Connect to the first of the addresses that accepts."""
    for n, address in enumerate(addresses, 1):
        try:
            left = max(deadline - time.monotonic(), 0.1)
            sock = socket.create_connection((address, port), min(CONNECT_SECONDS, left))
        except OSError:
            if n == len(addresses):
                raise
        else:
            sock.settimeout(max(deadline - time.monotonic(), 0.1))
            return sock
    raise OSError("the name has no address")
