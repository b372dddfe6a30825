"""Shares of owners, and work that ends with its client, at its deadline and with the service, on a real port."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import httpx2
import pytest
import uvicorn
from fastapi import FastAPI, Request
from starlette.requests import ClientDisconnect
from starlette.types import Message

from services.api.http import errors
from services.api.work import Shares, run
from services.runtime.problems import TooLarge
from tests.parts.waiting import until
from workflows.interruption import checkpoint

SECONDS = 2.0


@dataclass
class Works:
    """An API whose only route works until it is ended."""

    port: int = 0
    server: uvicorn.Server = field(init=False)
    thread: threading.Thread = field(init=False)
    working: set[str] = field(default_factory=set)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @contextmanager
    def asked(self, owner: str) -> Iterator[None]:
        """Ask for work whose deadline does not come, and hang up when the block ends."""
        with socket.create_connection(("127.0.0.1", self.port)) as connection:
            connection.sendall(f"GET /{owner}?seconds=600 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            yield


@pytest.fixture
def works() -> Iterator[Works]:
    made = Works()
    app, shares = FastAPI(), Shares(2, 1)
    errors.register(app)

    @app.get("/{owner}")
    async def work(request: Request, owner: str, seconds: float = SECONDS) -> None:
        def until_ended() -> None:
            made.working.add(owner)
            try:
                while True:
                    checkpoint()
                    time.sleep(0.01)
            finally:
                made.working.remove(owner)

        await run(request, owner, seconds, [(shares, 1)], until_ended)

    config = uvicorn.Config(app, port=0, log_config=None, lifespan="off", timeout_graceful_shutdown=1)
    with config.bind_socket() as bound:
        bound.listen()  # the server does so only when it has started
        made.port = bound.getsockname()[1]
        made.server = uvicorn.Server(config)
        made.thread = threading.Thread(target=made.server.run, kwargs={"sockets": [bound]})
        made.thread.start()
        yield made
        made.server.should_exit = True
        made.thread.join()


def test_work_ends_with_its_client_and_leaves_room_for_the_next(works: Works) -> None:
    with ExitStack() as stack:
        for _ in range(5):
            stack.enter_context(works.asked("alice"))
        until(lambda: "alice" in works.working)
        stack.enter_context(works.asked("bob"))  # alice cannot have both slots
        until(lambda: works.working == {"alice", "bob"})
    until(lambda: not works.working)


def test_work_of_a_client_that_has_gone_does_not_begin() -> None:
    begun = threading.Event()

    async def gone() -> Message:
        return {"type": "http.disconnect"}

    request = Request({"type": "http"}, gone)
    with pytest.raises(ClientDisconnect):
        asyncio.run(run(request, "alice", SECONDS, [(Shares(1, 1), 1)], begun.set))
    assert not begun.is_set()


def test_work_ends_at_its_deadline_with_a_remedy(works: Works) -> None:
    answer = httpx2.get(f"{works.url}/alice", timeout=60)
    problem = answer.json()
    assert (answer.status_code, problem["name"], problem["limit"]) == (422, "request_seconds", SECONDS)
    assert "ENVMATTE_REQUEST_SECONDS" in problem["detail"]
    assert not works.working


def test_work_ends_with_the_server(works: Works) -> None:
    with works.asked("alice"):
        until(lambda: works.working)
        works.server.should_exit = True
        works.thread.join(120)
        assert not works.thread.is_alive()
        until(lambda: not works.working)


def test_owners_take_turns_and_small_amounts_do_not_pass_large_ones() -> None:
    order: list[str] = []

    async def take(shares: Shares, name: str, owner: str, amount: int) -> None:
        async with shares.take(owner, SECONDS, amount):
            order.append(name)
            await asyncio.sleep(0.01)

    async def all_of_them() -> None:
        shares = Shares(4, 2)
        asked = [
            ("a1", "alice", 2),
            ("a2", "alice", 1),
            ("b1", "bob", 1),
            ("c1", "carol", 2),
            ("d1", "dave", 1),
        ]
        await asyncio.gather(*(take(shares, *one) for one in asked))

    asyncio.run(all_of_them())
    assert order == ["a1", "b1", "c1", "d1", "a2"]


def test_two_owners_with_many_requests_keep_a_third_waiting_for_one_turn() -> None:
    order: list[str] = []

    async def take(shares: Shares, owner: str) -> None:
        async with shares.take(owner, SECONDS):
            order.append(owner)
            await asyncio.sleep(0.01)

    async def all_of_them() -> None:
        shares = Shares(2, 1)
        await asyncio.gather(*(take(shares, owner) for owner in ["alice", "bob"] * 20 + ["carol"]))

    asyncio.run(all_of_them())
    assert order.index("carol") == 2


def test_turn_that_does_not_come_is_refused_with_when_to_try_again(works: Works) -> None:
    with works.asked("alice"):
        until(lambda: "alice" in works.working)
        answer = httpx2.get(f"{works.url}/alice?seconds=0.1", timeout=60)
    assert (answer.status_code, int(answer.headers["retry-after"]) > 0) == (429, True)


def test_more_than_an_owner_may_have_is_refused_by_the_setting() -> None:
    async def ask() -> None:
        async with Shares(100, 50, "request_memory").take("alice", SECONDS, 51):
            pass

    with pytest.raises(TooLarge, match="ENVMATTE_REQUEST_MEMORY") as caught:
        asyncio.run(ask())
    assert caught.value.fields == {"name": "request_memory", "limit": 50, "value": 51}


def test_turn_that_is_given_up_takes_nothing() -> None:
    async def give_up() -> None:
        shares = Shares(1, 1)
        async with shares.take("alice", SECONDS):
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.01), shares.take("bob", SECONDS):
                    pass
        async with shares.take("carol", SECONDS):
            pass

    asyncio.run(give_up())


def test_turn_that_is_given_up_lets_those_pass_that_waited_behind_it() -> None:
    async def give_up() -> None:
        shares = Shares(3, 3)
        async with shares.take("alice", SECONDS):
            large = asyncio.create_task(_taken(shares, "bob", 3))
            await asyncio.sleep(0)
            small = asyncio.create_task(_taken(shares, "carol", 1))
            await asyncio.sleep(0)
            large.cancel()
            await asyncio.wait_for(small, SECONDS / 2)

    asyncio.run(give_up())


async def _taken(shares: Shares, owner: str, amount: int) -> None:
    async with shares.take(owner, SECONDS, amount):
        pass


def test_what_is_kept_counts_for_its_owner_and_for_all() -> None:
    shares = Shares(4, 2)
    release = [shares.keep(owner, 2) for owner in ("alice", "bob")]
    assert not any(shares.exceeded(owner) for owner in ("alice", "bob", "carol"))
    release.append(shares.keep("alice", 1))
    assert all(shares.exceeded(owner) for owner in ("alice", "bob", "carol"))  # more than there is
    release[1]()
    assert [shares.exceeded(owner) for owner in ("alice", "bob", "carol")] == [True, False, False]
