"""Attempts to talk to a cluster. As a program: those of another user of this machine, at the ports that are named."""

import asyncio
import os
import ssl
import sys

from distributed.comm import connect as open_comm
from distributed.security import Security

from services.runtime import certificates

NOBODY = 65534
"""The user who owns nothing."""


async def gets_in(at: str, security: Security) -> bool:
    """Whether a dask client gets an answer."""
    try:
        opening = open_comm(at, timeout=2, **security.get_connection_args("client"))
        comm = await asyncio.wait_for(opening, 5)
        try:
            await comm.write({"op": "identity", "reply": True})
            reply = await asyncio.wait_for(comm.read(), 5)
        finally:
            comm.abort()
    except (OSError, TimeoutError, ValueError):  # of tornado, if the connection ends before TLS begins
        return False
    return bool(reply["id"])


async def answers_without_certificate(port: int) -> bool:
    """Whether a TLS server answers a client without a certificate."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        reader, writer = await asyncio.wait_for(asyncio.open_connection("127.0.0.1", port, ssl=context), 5)
        try:
            answer = await asyncio.wait_for(reader.read(1), 5)
        finally:
            writer.transport.abort()
    except (OSError, TimeoutError):
        return False
    return bool(answer)


async def gets_in_anyhow(port: int) -> bool:
    """Whether any way in works for one without the cluster's certificates."""
    others = certificates.new_security()
    attempts = (
        gets_in(f"tcp://127.0.0.1:{port}", Security()),
        gets_in(f"tls://127.0.0.1:{port}", others),
        answers_without_certificate(port),
    )
    return any(await asyncio.gather(*attempts))


async def main(ports: list[str]) -> None:
    found = await asyncio.gather(*(gets_in_anyhow(int(port)) for port in ports))
    for port, got_in in zip(ports, found, strict=True):
        print(port, got_in)


if __name__ == "__main__":
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    asyncio.run(main(sys.argv[1:]))
