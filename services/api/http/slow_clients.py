"""Connections of the service's port: who is slow must not keep others out, nor have the service hold much for him."""

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
"""Seconds that the head of a request may take, from the connection or from its first byte on."""
PATIENCE = 30.0
"""Seconds between two looks at whether the other side sends the body that it began, and takes the answer that it
asked for."""
LEAST = 1000
"""Bytes of it that must have gone over from one look to the next, some 33 a second: no network is as slow."""


class Connection(H11Protocol):
    """A connection that is closed if the other side does not do its part.

    uvicorn waits for ever for a connection's first request, for the rest of a head or of a body that has begun, and for
    an answer to be taken: each wait holds one of the files that this process may have open, and what it has of the
    answer. A body that is given up is a `ClientDisconnect` to whom reads it.
    """

    _overdue: asyncio.TimerHandle | None = None
    _looking: asyncio.TimerHandle | None = None
    _received = 0
    _seen: "tuple[int, int, object, int]" = (0, 0, None, 0)

    def connection_made(self, transport: Any) -> None:
        super().connection_made(_Counting(transport))  # type: ignore[arg-type]
        self._watch()
        self._looking = self.loop.call_later(PATIENCE, self._look)

    def data_received(self, data: bytes) -> None:
        self._received += len(data)
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._forget()
        if self._looking is not None:
            self._looking.cancel()

    def _watch(self) -> None:
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            self._forget()
        elif self._overdue is None:
            self._overdue = self.loop.call_later(HEAD, self.transport.close)

    def _forget(self) -> None:
        if self._overdue is not None:
            self._overdue.cancel()
            self._overdue = None

    def _look(self) -> None:
        """Give the connection up if since the last look the other side has not done what it had to."""
        transport: Any = self.transport
        unsent = transport.unsent()
        taken = transport.written - unsent
        body = self.cycle if self._is_owed_a_body() else None
        before, had_taken, of, had_received = self._seen
        is_stuck = unsent and taken - had_taken < min(before, LEAST)
        is_silent = body is not None and body is of and self._received - had_received < LEAST
        if is_stuck or is_silent:
            logger.info(
                "gave up a connection: %s",
                "nobody takes the answer" if is_stuck else "the body does not go on",
            )
            transport.abort()
            return
        self._seen = unsent, taken, body, self._received
        self._looking = self.loop.call_later(PATIENCE, self._look)

    def _is_owed_a_body(self) -> bool:
        """Whether the other side is to send, and nothing here keeps it from that."""
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
        """Bytes that have not reached the other side: here, and with the system."""
        with_system = fcntl.ioctl(self.get_extra_info("socket").fileno(), termios.TIOCOUTQ, bytes(4))
        held: int = self.get_write_buffer_size() + struct.unpack("i", with_system)[0]
        return held


def allow_many() -> None:
    """Let this process have as many connections and files open as the system allows it, not some thousand."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
