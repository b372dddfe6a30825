"""Addresses that a process listens on."""

import asyncio
import os
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


@pytest.mark.parametrize("host", [os.fsdecode(b"caf\xe9"), "a\0b"])
def test_what_is_no_host_name_is_reported(host: str) -> None:
    with pytest.raises(Conflict, match="not a host name"):
        bind(host, 0)


def test_connections_send_without_delay() -> None:
    """The body of an answer, sent after its head, must not wait for the client to acknowledge the head."""

    async def option() -> int:
        accepted = asyncio.get_running_loop().create_future()
        server = await asyncio.start_server(
            lambda _, writer: accepted.set_result(writer), sock=bind("127.0.0.1", 0)
        )
        async with server:
            _, client = await asyncio.open_connection(*server.sockets[0].getsockname())
            writer = await accepted
            found: int = writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            for one in (client, writer):
                one.close()
            return found

    assert asyncio.run(option())
