"""The process that decoders are forked from.

It is started without the environment of the service, imports what decoders need, and never reads a file from outside.
So a decoder starts in milliseconds, and its memory holds nothing of the service.

Each process that needs decoders has one server, and asks it for a decoder by sending two sockets. Over one the decoder
is given files and answers. The other says whether it is wanted: when that is closed the decoder is killed, and when the
decoder has ended its exit code is sent over it.
"""

import atexit
import gc
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import wait
from typing import NoReturn

from workflows.untrusted import decoder_process
from workflows.untrusted.tiff_lzw import load_kernel

MODULES = ("workflows.images.decode", "workflows.ingest.stills", "workflows.ingest.films")
"""What decoders run; imported before the first is forked."""
LOADER = ("LD_LIBRARY_PATH",)
"""Variables that a server is started with, because Python itself may need them. Nothing else can be read about it."""
CACHES = ("HOME", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
"""Variables that it is given afterwards: by them numba finds its cache."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""And those that keep libraries from starting threads, with which it could not be forked safely."""
GRACE = 0.1
"""Seconds that a decoder gets to end before it is killed."""
EXIT = struct.Struct("<i")
_REQUEST = struct.Struct("<Q")  # the bytes that a decoder may allocate
_START = (
    "import json, os, sys; sys.path[:], variables, modules = json.loads(sys.argv[1]); os.environ.update(variables); "
    "from workflows.untrusted.decoder_server import main; main(modules)"
)


class Server:
    """The server of this process, which is started when it is first needed, and again if it has died."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None

    def start(self) -> None:
        """Start it, if it is not running. It takes a second until it is ready, in which requests wait."""
        with self._lock:
            self._running()

    def fork(self, memory: int) -> tuple[socket.socket, socket.socket]:
        """Fork a decoder.

        Parameters
        ----------
        memory : int
            Bytes that it may allocate.

        Returns
        -------
        connection : socket
            To the decoder.
        wanted : socket
            Shut down to kill it; receives `EXIT`, its exit code as of `subprocess`.
        """
        connection, wanted = socket.socketpair(), socket.socketpair()
        with connection[1], wanted[1]:
            numbers = [connection[1].fileno(), wanted[1].fileno()]
            with self._lock:
                for _ in range(2):  # it may have died since it was looked at
                    with suppress(BrokenPipeError, ConnectionResetError):
                        socket.send_fds(self._running(), [_REQUEST.pack(memory)], numbers)
                        break
        return connection[0], wanted[0]

    def stop(self) -> None:
        """Stop it, and all decoders."""
        with self._lock:
            if self._process is not None and self._control is not None:
                self._control.close()
                self._process.wait()
            self._process = self._control = None

    def _running(self) -> socket.socket:
        if self._control is None or self._process is None or self._process.poll() is not None:
            if self._control is not None:
                self._control.close()
            self._control, control = socket.socketpair()
            paths = [os.path.abspath(path) for path in sys.path]
            start = paths, _variables(CACHES) | ONE_THREAD, MODULES
            with control:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", _START, json.dumps(start)],
                    stdin=control.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=_variables(LOADER),
                    cwd="/",
                    process_group=0,  # a terminal sends Ctrl-C to a group; the server ends with its service
                )
        return self._control


server = Server()
atexit.register(server.stop)


def _variables(names: tuple[str, ...]) -> dict[str, str]:
    return {name: os.environ[name] for name in names if name in os.environ}


def main(modules: list[str]) -> None:
    """Import modules, and fork decoders on request until the socket that is standard input is closed."""
    # Sent to all processes of a service, they are for the one that started this, which ends it.
    for ignored in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ignored, signal.SIG_IGN)
    gc.disable()  # no module is garbage
    for module in modules:
        import_module(module)
    load_kernel()  # here it may still be compiled and cached
    os.environ.clear()  # nothing needs it any more
    gc.freeze()  # a collection would touch, and so copy, all memory that decoders share
    gc.enable()
    control = socket.socket(fileno=0)
    # By the socket that says whether it is wanted: its process, and a pipe that is closed when it ends.
    decoders: dict[socket.socket, tuple[int, int]] = {}
    while True:
        ready = wait([control, *decoders, *(ended for _, ended in decoders.values())])
        for wanted, (process, ended) in list(decoders.items()):
            if wanted in ready or ended in ready:
                wait([ended], GRACE)  # it ends itself when its connection is closed, unless it is busy
                os.kill(process, signal.SIGKILL)
                code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
                with suppress(OSError):  # nobody waits for it
                    wanted.sendall(EXIT.pack(code))
                wanted.close()
                os.close(ended)
                del decoders[wanted]
        if control in ready:
            request, numbers, _, _ = socket.recv_fds(control, _REQUEST.size, 2)
            if not request:
                for process, _ in decoders.values():
                    os.kill(process, signal.SIGKILL)
                return
            connection, number = numbers
            (memory,) = _REQUEST.unpack(request)
            ended, open_until_end = os.pipe()
            process = os.fork()
            if not process:
                _decode(connection, open_until_end, memory)
            os.close(connection)
            os.close(open_until_end)
            decoders[socket.socket(fileno=number)] = process, ended


def _decode(connection: int, open_until_end: int, memory: int) -> NoReturn:
    """Be a decoder, and end."""
    try:
        decoder_process.run(connection, open_until_end, memory)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)
