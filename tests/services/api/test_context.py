"""Requests that go on after their key was checked, against a real database."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fastapi import FastAPI, Request
from fastapi.testclient import TestClient

from services.api.auth import Caller, identify
from services.api.context import KEY_CHECK, Context
from services.api.work import RequestShares, Shares
from services.decoding.pool import Decoders
from services.runtime.problems import Unauthorized
from services.settings import Settings
from storage.database.engine import open_engine, writing
from storage.errors import Corrupt, NotFound
from storage.objects.store import Objects
from storage.records import api_keys, mattes
from tests.parts.captures import captured, nested_program
from tests.services.api.mattes.archives import archive
from workflows.composite.cache import Cache


def test_download_ends_when_its_key_is_revoked(tmp_path: Path) -> None:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
    with writing(engine) as c:
        key = api_keys.create(c, "lab", "alice", "read")
    settings, objects = Settings(data=tmp_path), Objects((tmp_path / "store").as_uri())
    check_key = partial(identify, settings, engine, key)
    decoders = Decoders(settings.backdrop_bytes)  # no process starts before the first picture
    shares = RequestShares(memory=Shares(1, 1), backdrops=Shares(1, 1))
    cache = Cache(objects, 0)
    context = Context(settings, engine, objects, cache, decoders, shares, check_key=check_key)

    def pieces() -> Iterator[bytes]:
        for n in range(5):
            if n == 3:
                with writing(engine) as c:
                    api_keys.revoke(c, "lab")
            time.sleep(1.1 * KEY_CHECK)
            yield bytes([n])

    sent: list[bytes] = []
    with pytest.raises(Unauthorized):
        sent.extend(context.while_allowed(pieces()))
    engine.dispose()
    assert sent == [b"\0", b"\1", b"\2"]


@pytest.fixture
def context(tmp_path: Path) -> Iterator[Context]:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
    settings, objects = Settings(data=tmp_path), Objects((tmp_path / "store").as_uri())
    cache = Cache(objects, 0)
    shares = RequestShares(memory=Shares(8, 4, "request_memory"), backdrops=Shares(1, 1))
    decoders = Decoders(settings.backdrop_bytes)
    yield Context(settings, engine, objects, cache, decoders, shares)
    engine.dispose()


def test_what_was_deleted_while_it_was_read_is_not_damaged(context: Context) -> None:
    def read(deleted: bool) -> None:
        with context.stored(mattes.get, "m"):
            if deleted:
                with writing(context.engine) as c:
                    mattes.delete(c, "m")
            raise Corrupt("a block is missing")

    with writing(context.engine) as c:
        mattes.add_imported(c, "m", {}, {})
    with pytest.raises(Corrupt):
        read(deleted=False)
    for _ in range(2):  # while it is read, and before
        with pytest.raises(NotFound):
            read(deleted=True)


def test_work_larger_than_an_owners_share_of_memory_is_done_one_at_a_time(context: Context) -> None:
    async def receive() -> dict[str, str]:
        await asyncio.Event().wait()
        raise AssertionError

    request = Request({"type": "http"}, receive)
    at_once: list[int] = []
    running: set[int] = set()

    def work() -> None:
        running.add(threading.get_ident())
        time.sleep(0.05)
        at_once.append(len(running))
        running.remove(threading.get_ident())

    async def several() -> None:
        slots = Shares(9, 9)
        await asyncio.gather(*(context.compute(request, slots, work, memory=100) for _ in range(3)))

    asyncio.run(several())
    assert at_once == [1, 1, 1]


def test_calls_that_wait_hold_up_no_other_owner(context: Context) -> None:
    released = threading.Event()

    async def of_two_owners() -> None:
        alice, bob = (replace(context, caller=Caller(owner, "write")) for owner in ("alice", "bob"))
        waiting = [asyncio.create_task(alice.call(released.wait, 60)) for _ in range(50)]
        try:
            async with asyncio.timeout(30):
                assert await bob.call(lambda: "done") == "done"
        finally:
            released.set()
        assert all(await asyncio.gather(*waiting))

    asyncio.run(of_two_owners())


@pytest.mark.parametrize("route", ["captures", "mattes"])
def test_archives_are_checked_once_there_is_memory(
    tmp_path: Path, build: Callable[..., FastAPI], route: str
) -> None:
    if route == "mattes":
        sent = archive(tmp_path / "made", 8, 8)
    else:
        program = nested_program(bands=((8, 6, 16),), levels=2)
        sent = captured(program, lambda n, picture: np.zeros((8, 8, 1)))
    app = build(request_seconds=1)
    memory = app.state.context.shares.memory
    with TestClient(app, "http://127.0.0.1", headers={"Content-Type": "application/zip"}) as client:
        assert client.portal is not None
        with ExitStack() as taken:
            for other in ("alice", "bob"):
                turn = memory.take(other, 1, memory.each)
                taken.enter_context(client.portal.wrap_async_context_manager(turn))
            answer = client.post(f"/v1/{route}", content=sent)
            assert (answer.status_code, answer.json()["type"]) == (429, "urn:envmatte:problem:too-many")
        assert client.post(f"/v1/{route}", content=sent).status_code == 201


def test_archives_are_sent_in_turn(tmp_path: Path, build: Callable[..., FastAPI]) -> None:
    app = build(request_seconds=1)
    archives, sent = app.state.context.shares.archives, archive(tmp_path / "made", 8, 8)
    with TestClient(app, "http://127.0.0.1", headers={"Content-Type": "application/zip"}) as client:
        assert client.portal is not None
        matte = client.post("/v1/mattes", content=sent).json()["id"]
        with ExitStack() as taken:
            for other in ("alice", "bob"):
                turn = archives.take(other, 1, archives.each)
                taken.enter_context(client.portal.wrap_async_context_manager(turn))
            answer = client.get(f"/v1/mattes/{matte}/archive")
            assert (answer.status_code, answer.json()["type"]) == (429, "urn:envmatte:problem:too-many")
        assert client.get(f"/v1/mattes/{matte}/archive").content == sent
        assert client.get("/v1/mattes/none/archive").status_code == 404
