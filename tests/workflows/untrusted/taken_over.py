"""What a decoder might do that a hostile file has taken over. A decoder imports this module before it is confined."""

import contextlib
import ctypes
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from workflows.untrusted.decoder_process import say_alive

PTRACE_ATTACH = 16  # sys/ptrace.h


def attacks(victim: int, secret: str) -> dict[str, Callable[[], object]]:
    """What it tries against the process of its service, by name; each must fail with an OSError."""
    library = ctypes.CDLL(None, use_errno=True)

    def called(result: int) -> int:
        if result < 0:
            raise OSError(ctypes.get_errno(), "refused")
        return result

    def changed() -> None:
        with open(secret, "ab") as file:
            file.write(b"changed")

    return {
        "environment of the service": Path(f"/proc/{victim}/environ").read_bytes,
        "memory of the service": lambda: open(f"/proc/{victim}/mem", "rb"),
        "files of the service": lambda: os.listdir(f"/proc/{victim}/fd"),
        "read the database": Path(secret).read_bytes,
        "write the database": changed,
        "a new file": lambda: open(f"{secret}-new", "wb"),
        "delete the database": lambda: os.unlink(secret),
        "rename the database": lambda: os.rename(secret, f"{secret}-moved"),
        "a link to it": lambda: os.symlink(secret, f"{secret}-link"),
        "mode of the database": lambda: os.chmod(secret, 0o777),
        "the working folder": lambda: os.listdir("."),
        "passwords": Path("/etc/passwd").read_bytes,
        "TCP": lambda: socket.socket(socket.AF_INET),
        "UDP": lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM),
        "local socket": lambda: socket.socket(socket.AF_UNIX),
        "pair of sockets": socket.socketpair,
        "fork": os.fork,
        "vfork": lambda: subprocess.run([sys.executable, "-c", ""], check=True),
        "exec": lambda: os.execv("/bin/true", ["true"]),
        "kill": lambda: os.kill(victim, 0),
        "ptrace": lambda: called(library.ptrace(PTRACE_ATTACH, victim, 0, 0)),
        "read memory by call": lambda: called(library.process_vm_readv(victim, 0, 0, 0, 0, 0)),
        "limits of the service": lambda: called(
            library.prlimit(victim, 7, None, ctypes.create_string_buffer(16))
        ),
        "shared memory": lambda: called(library.shmget(0, 4096, 0o1600)),
        "standard output": lambda: called(os.isatty(1) - 1),
        "namespaces": lambda: called(library.unshare(0x10000000)),
    }


def stumble(file: BinaryIO) -> Iterator[dict[str, Any]]:
    """Fail as a library does."""
    yield {}
    raise RuntimeError("libglass: bad huffman code")


def attack(file: BinaryIO, victim: int, secret: str) -> Iterator[dict[str, Any]]:
    """Try everything; yields what was not refused, and what is open."""
    done = []
    for name, what in attacks(victim, secret).items():
        with contextlib.suppress(OSError):
            what()
            done.append(name)
    sizes = [os.fstat(number).st_rdev for number in range(3)]
    others = []
    for number in range(5, 1000):
        with contextlib.suppress(OSError):
            os.fstat(number)
            others.append(number)
    yield {"done": done, "environment": sorted(os.environ), "devices": len(set(sizes)), "others": others}


def send(file: BinaryIO) -> Iterator[dict[str, Any]]:
    """Send the bytes of the file in place of an answer, and end."""
    os.write(3, file.read())
    os._exit(0)
    yield {}


def crash(file: BinaryIO) -> Iterator[dict[str, Any]]:
    """Read from nowhere."""
    ctypes.string_at(0)
    yield {}


def hang(file: BinaryIO) -> Iterator[dict[str, Any]]:
    """Never answer; the file says whether signs of life are sent, and until then."""
    end = time.monotonic() + struct.unpack("<d", file.read(8))[0]
    while time.monotonic() < end:
        say_alive()
        time.sleep(0.01)
    yield {"alive": True}


def measure(file: BinaryIO) -> Iterator[dict[str, int]]:
    """Read a file whole."""
    data = file.read()
    yield {"size": len(data)}


def hoard(file: BinaryIO, size: int) -> Iterator[np.ndarray]:
    """Take memory."""
    yield np.ones(size, np.uint8)[:1]


def read_back(file: BinaryIO) -> Iterator[Any]:
    """Read the file from its end to its start in pieces of odd sizes."""
    end = file.seek(0, os.SEEK_END)
    pieces = []
    for size in (1, 70_000, 3, 300_001):
        end = max(end - size, 0)
        file.seek(end)
        pieces.append(file.read(size))
    ignored = [number for number in signal.Signals if signal.getsignal(number) == signal.SIG_IGN]
    yield {"ignored": [number.name for number in ignored]}
    yield np.frombuffer(b"".join(pieces), np.uint8)
