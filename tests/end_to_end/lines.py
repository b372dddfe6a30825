"""A TCP proxy that cuts its connections at random, reproducibly for a seed."""

import contextlib
import random
import socket
import threading
import time
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit


class Line:
    """A proxy on its own port.

    Parameters
    ----------
    target : str
        URL to forward to; may be changed while it runs.
    cuts : int
        Number of connections it cuts before it stops cutting.
    mean : int
        Mean number of bytes from the client between two cuts.
    back : bool
        Whether half of the cuts come after the request was sent, while the answer is on its way.
    pace : float
        Minimum number of seconds per 64 KiB from the client.
    """

    def __init__(
        self, target: str, *, cuts: int = 0, mean: int = 0, back: bool = False, seed: int = 0, pace: float = 0
    ) -> None:
        self.target = target
        self.made = 0
        """Cuts so far."""
        self.carried = 0
        """Bytes from the client that were forwarded."""
        self._cuts, self._mean, self._back, self._pace = cuts, mean, back, pace
        self._random = random.Random(seed)
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._accept)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._carry, args=(client,), daemon=True).start()

    def _carry(self, client: socket.socket) -> None:
        where = urlsplit(self.target)
        try:
            server = socket.create_connection((where.hostname, where.port))
        except OSError:
            client.close()
            return
        with self._lock:
            breaks = self.made < self._cuts
            budget = int(self._random.expovariate(1 / self._mean)) if breaks else None
            back = self._back and self._random.random() < 0.5
        cut = threading.Event()
        answers = threading.Thread(target=self._answer, args=(server, client, cut), daemon=True)
        answers.start()
        carried = 0
        with contextlib.suppress(OSError):
            while data := client.recv(1 << 16):
                if budget is not None and carried + len(data) > budget:
                    if back:
                        cut.set()
                    else:
                        data = data[: budget - carried]
                server.sendall(data)
                carried += len(data)
                with self._lock:
                    self.carried += len(data)
                if budget is not None and carried >= budget and not back:
                    break
                time.sleep(self._pace * len(data) / (1 << 16))
        if budget is not None and not back and carried >= budget:
            self._count()
            _close(client)
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_WR)
        answers.join()
        _close(client)
        _close(server)

    def _answer(self, server: socket.socket, client: socket.socket, cut: threading.Event) -> None:
        with contextlib.suppress(OSError):
            while data := server.recv(1 << 16):
                if cut.is_set():
                    self._count()
                    break
                client.sendall(data)
        _close(client)

    def _count(self) -> None:
        with self._lock:
            self.made += 1


def _close(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
