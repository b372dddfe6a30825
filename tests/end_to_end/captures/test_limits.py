"""Limits count bytes while they come, to either service of one database: together they take what there is room for."""

import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.end_to_end.captures.tus import CHUNK, TUS, create, offset_of
from tests.end_to_end.conftest import Service, serving
from tests.parts.postgres import Server
from tests.parts.waiting import until

MB = 1 << 20
LIMIT = 60 * MB


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory, postgresql_server: Server) -> Iterator[list[Service]]:
    """Two services of one database and one store."""
    folder = tmp_path_factory.mktemp("limited")
    store = (folder / "first" / "store").as_uri()
    limits = {"ENVMATTE_STORE_BYTES": str(LIMIT)}
    with postgresql_server.database() as url:
        options = ("--workers", "1", "--database", url, "--store", store)
        with serving(folder / "first", *options, **limits) as first:
            limits["ENVMATTE_COORDINATE"] = "false"
            with serving(folder / "second", *options, **limits) as second:
                yield [first, second]


def size_of_store(service: Service) -> int:
    store = service.data / "store"
    return sum(Path(folder, name).lstat().st_size for folder, _, names in os.walk(store) for name in names)


@contextmanager
def watched(service: Service) -> Iterator[list[int]]:
    """Collects the sizes of the store until the block ends."""
    sizes, over = [0], threading.Event()

    def watch() -> None:
        while not over.wait(0.05):
            with suppress(FileNotFoundError):
                sizes.append(size_of_store(service))

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        yield sizes
    finally:
        over.set()
        watching.join()


def send_unfinished(service: Service, request: str, size: int, seconds: float, **headers: str) -> int:
    """Send bytes of a chunked body, and not its end; returns the answer's status, 0 if none comes in ``seconds``."""
    host = urlsplit(service.url)
    with socket.create_connection((host.hostname, host.port), timeout=60) as raw:
        lines = {"Host": "localhost", "Transfer-Encoding": "chunked"} | headers
        head = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in lines.items())
        raw.sendall(f"{request} HTTP/1.1\r\n{head}\r\n".encode())
        with suppress(ConnectionError):  # it is answered before all is sent
            for _ in range(size // MB):
                raw.sendall(b"%x\r\n%s\r\n" % (MB, bytes(MB)))
        raw.settimeout(seconds)
        try:
            return int(raw.recv(12).split()[1])
        except TimeoutError:
            return 0


@pytest.mark.slow
def test_unfinished_bodies_stay_within_the_limit(limited: list[Service]) -> None:
    requests = ["POST /v1/captures", "POST /v1/captures", "POST /v1/mattes"] * 2
    send = partial(send_unfinished, size=LIMIT // 2, seconds=2, Content_Type="application/zip")
    with watched(limited[0]) as sizes, ThreadPoolExecutor(6) as pool:
        answers = [*pool.map(send, limited * 3, requests)]
    assert max(sizes) <= LIMIT + MB
    # Those that are not refused are held; all may be refused if they meet the limit at the same moment.
    assert {507} <= set(answers) <= {0, 507}
    # The clients of these are gone. Their bytes are deleted first, then what was reserved for them is released.
    until(lambda: size_of_store(limited[0]) < MB and limited[0].used()["store_bytes"] < MB)


@pytest.mark.slow
def test_an_upload_has_one_writer(limited: list[Service]) -> None:
    where = create(limited[0], 40 * MB)
    sha = {"Upload_Checksum": "sha1 AAAA", "Upload_Offset": "0"} | CHUNK
    send = partial(send_unfinished, size=32 * MB, seconds=8, **sha)
    with watched(limited[0]) as sizes, ThreadPoolExecutor(4) as pool:
        answers = [*pool.map(send, limited * 2, [f"PATCH {where}"] * 4)]
    assert max(sizes) <= 40 * MB + MB
    assert sorted(answers) == [0, 409, 409, 409]
    until(lambda: size_of_store(limited[0]) < MB)
    assert offset_of(limited[0], where) == 0
    limited[0].http.delete(where, headers=TUS)
