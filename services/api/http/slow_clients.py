"""Connections that are closed when a client is too slow, so that slow clients do not use up files and memory."""

import asyncio
import fcntl
import logging
import resource
import struct
import termios
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

logger = logging.getLogger(__name__)

HEAD = 15.0
"""Seconds in which the head of a request must arrive, from the connection or from its first byte on."""
IDLE = 75
"""Seconds that a connection stays open between two requests: longer than clients and proxies keep one that they use
again (httpx 5, nginx 60), else it is closed while their next request is under way, and that fails."""
MOST_HEAD = 16 << 10
"""Most bytes of the head of a request."""
CHECK_SECONDS = 30.0
"""Seconds between two checks that the client goes on to send its request's body, and to read the answer."""
MIN_RATE = 1000
"""Bytes per second that must have been transferred between two checks: less than any network gives."""


class _Unambiguous(h11.Connection):
    """A reader of requests that refuses one with both a length and chunks.

    A proxy before the service may take the other for its end, and what follows for another client's request (RFC 9112,
    sect. 6.1 and 11.2).
    """

    def next_event(self) -> Any:
        event = super().next_event()
        if isinstance(event, h11.Request):
            names = {name for name, _ in event.headers}
            if {b"content-length", b"transfer-encoding"} <= names:
                raise h11.RemoteProtocolError("a request has both a length and chunks")
        return event


class Connection(H11Protocol):
    """A connection of uvicorn that is closed if the client stops sending or reading.

    uvicorn waits without limit for a connection's first request, for the rest of a head or a body, and for the client
    to read an answer. Each wait holds one of the files that this process may have open, and the answer's bytes. When
    a connection is closed, reading its body raises `ClientDisconnect`.
    """

    _head_timer: asyncio.TimerHandle | None = None
    _check_timer: asyncio.TimerHandle | None = None
    _received = 0
    _last: "tuple[int, int, object, int]" = (0, 0, None, 0)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.conn = _Unambiguous(h11.SERVER, MOST_HEAD)
        self.timeout_keep_alive = IDLE

    def connection_made(self, transport: Any) -> None:
        super().connection_made(_Counting(transport))  # type: ignore[arg-type]
        self._watch()
        self._check_timer = self.loop.call_later(CHECK_SECONDS, self._check)

    def data_received(self, data: bytes) -> None:
        self._received += len(data)
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._forget()
        if self._check_timer is not None:
            self._check_timer.cancel()

    def _watch(self) -> None:
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            self._forget()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(HEAD, self.transport.close)

    def _forget(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _check(self) -> None:
        """Close the connection if the client has not made progress since the last check."""
        transport: Any = self.transport
        unsent = transport.unsent()
        sent = transport.written - unsent
        request = self.cycle if self._expects_body() else None
        last_unsent, last_sent, last_request, last_received = self._last
        least = MIN_RATE * CHECK_SECONDS
        is_stuck = unsent and sent - last_sent < min(last_unsent, least)
        is_silent = request is not None and request is last_request and self._received - last_received < least
        if is_stuck or is_silent:
            logger.info(
                "closed a connection: %s",
                "the client does not read the answer" if is_stuck else "the client stopped sending the body",
            )
            transport.abort()
            return
        self._last = unsent, sent, request, self._received
        self._check_timer = self.loop.call_later(CHECK_SECONDS, self._check)

    def _expects_body(self) -> bool:
        """Whether the client has to send a body, and nothing on this side keeps it from that."""
        return (
            self.conn.their_state is h11.SEND_BODY
            and not self.flow.read_paused
            and not self.cycle.waiting_for_100_continue
        )


class _Counting:
    """A transport that counts what is written to it."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self.written = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        self.written += len(data)
        self._transport.write(data)

    def unsent(self) -> int:
        """Bytes that have not reached the client: in this process, and in the kernel."""
        in_kernel = fcntl.ioctl(self.get_extra_info("socket").fileno(), termios.TIOCOUTQ, bytes(4))
        unsent: int = self.get_write_buffer_size() + struct.unpack("i", in_kernel)[0]
        return unsent


def raise_file_limit() -> None:
    """Raise the limit of open files and connections to the most that the system allows this process."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
