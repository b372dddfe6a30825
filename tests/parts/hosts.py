"""Several hosts on one machine: network namespaces, whose links to a switch can be cut."""

import ctypes
import os
import secrets
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest

from services.runtime import certificates
from tests.parts.rig import Rig, free_port, url_of

HOSTS = ("scheduler", "service0", "worker0", "worker1")
"""One host for each process."""
NETWORK = "10.77.0"
NAMESPACES = Path("/run/netns")
CLONE_NEWNET = 0x40000000


@dataclass(frozen=True)
class Network:
    """Hosts and the switch between them."""

    mark: str
    names: Sequence[str]

    def namespace(self, name: str) -> str:
        return f"{self.mark}-{name}"

    def address(self, name: str) -> str:
        return f"{NETWORK}.{self.names.index(name) + 1}"

    def cut(self, name: str) -> None:
        """Take a host's link down; no connection is closed."""
        self._set(name, "down")

    def mend(self, name: str) -> None:
        self._set(name, "up")

    def _set(self, name: str, state: str) -> None:
        _ip("-n", self.namespace("switch"), "link", "set", f"port{self.names.index(name)}", state)


@contextmanager
def network(*names: str) -> Iterator[Network]:
    """Make connected hosts until the block ends; skips the test where that is impossible."""
    if os.getuid() != 0:
        pytest.skip("network namespaces take root")
    if shutil.which("ip") is None:
        pytest.skip("network namespaces take the program ip, of the package iproute2")
    made = Network(f"envmatte-{secrets.token_hex(3)}", names)
    switch = made.namespace("switch")
    first = subprocess.run(["ip", "netns", "add", switch], capture_output=True, text=True)
    if first.returncode:
        pytest.skip(f"network namespaces can't be had here: {first.stderr.strip()}")
    try:
        _ip("-n", switch, "link", "add", "bridge0", "type", "bridge")
        _ip("-n", switch, "link", "set", "bridge0", "up")
        for n, name in enumerate(names):
            host, port = made.namespace(name), f"port{n}"
            _ip("netns", "add", host)
            _ip("-n", switch, "link", "add", port, "type", "veth", "peer", "name", "eth0", "netns", host)
            _ip("-n", switch, "link", "set", port, "master", "bridge0", "up")
            _ip("-n", host, "addr", "add", f"{made.address(name)}/24", "dev", "eth0")
            for link in ("lo", "eth0"):
                _ip("-n", host, "link", "set", link, "up")
        yield made
    finally:
        for name in (*names, "switch"):
            subprocess.run(["ip", "netns", "delete", made.namespace(name)], capture_output=True)


class Hosts(Rig):
    """A scheduler, a service and two workers, on four hosts that speak TLS."""

    def _start_all(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.network = self._stack.enter_context(network(*HOSTS))
        # Requests to the service come from its own host.
        inside = self._stack.enter_context(
            ThreadPoolExecutor(1, initializer=_enter, initargs=(self.network.namespace("service0"),))
        )
        self._inside = inside
        certificates.make(self.folder / "certs")
        trusted = ("--certs", str(self.folder / "certs"))
        port = free_port()
        self.cluster = f"tls://{self.network.address('scheduler')}:{port}"
        self.start("scheduler", "scheduler", "--host", "0.0.0.0", "--port", str(port), *trusted)
        for n in range(2):
            self.start(f"worker{n}", "worker", "--cluster", self.cluster, "--workers", "1", *trusted)
        where = ["--data", str(self.folder / "data"), "--cluster", self.cluster, "--store", self.store]
        self.start("service0", "serve", "--port", "0", *where, *trusted)
        self.urls = [url_of(self._processes["service0"])]

    def _within(self, name: str) -> Sequence[str]:
        return "ip", "netns", "exec", self.network.namespace(name)

    def _request(self, method: str, url: str, **content: Any) -> httpx2.Response:
        return self._inside.submit(super()._request, method, url, **content).result()


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def _enter(namespace: str) -> None:
    """Put the calling thread on a host."""
    with (NAMESPACES / namespace).open() as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"can't enter {namespace}")
