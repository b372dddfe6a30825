"""Connections of the service's port: who is slow must not keep others out."""

import asyncio
import resource
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD = 15.0
"""Seconds that the head of a request may take, from the connection or from its first byte on."""


class Connection(H11Protocol):
    """A connection that is closed if the head of a request takes too long to come.

    uvicorn waits for ever for a connection's first request, and for the rest of a head that has begun; each wait holds
    one of the files that this process may have open. A request whose body stalls is the handler's to give up.
    """

    _overdue: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._forget()

    def _watch(self) -> None:
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            self._forget()
        elif self._overdue is None:
            self._overdue = self.loop.call_later(HEAD, self.transport.close)

    def _forget(self) -> None:
        if self._overdue is not None:
            self._overdue.cancel()
            self._overdue = None


def allow_many() -> None:
    """Let this process have as many connections and files open as the system allows it, not some thousand."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
