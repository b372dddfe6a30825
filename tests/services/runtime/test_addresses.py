"""Addresses that a process listens on."""

import socket

import pytest

from services.runtime.addresses import PortTaken, bind, url_of
from storage.errors import Conflict


@pytest.mark.parametrize(("host", "written"), [("127.0.0.1", "127.0.0.1"), ("::1", "[::1]")])
def test_a_free_port_is_bound_and_its_url_can_be_reached(host: str, written: str) -> None:
    with bind(host, 0) as bound:
        bound.listen()
        port = bound.getsockname()[1]
        assert url_of(host, port) == f"http://{written}:{port}"
        socket.create_connection((host, port)).close()
        with pytest.raises(PortTaken, match=f"port {port} of {host}"):
            bind(host, port)


def test_an_address_that_is_not_this_machines_is_reported() -> None:
    with pytest.raises(
        Conflict, match=r"can't listen on 192\.0\.2\.1, port 0: Cannot assign requested address"
    ):
        bind("192.0.2.1", 0)
