"""Which coordinator sends webhooks, and what happens to those that are not accepted."""

import socket
import threading
import time

import pytest
from sqlalchemy import Engine, select

from services.settings import Settings
from services.webhooks.sender import Sender
from storage.database.engine import reading, writing
from storage.database.tables import deliveries as table
from storage.records import jobs, leases, webhook_deliveries
from tests.parts.waiting import until
from tests.services.webhooks.receivers import receiver

SECRET = "a secret of sixteen and more"


def settings(*, private: bool = True) -> Settings:
    return Settings(_env_file=None, webhook_secret=SECRET, webhook_private=private)


def ended(engine: Engine, url: str) -> str:
    with writing(engine) as c:
        job = jobs.add(c, "recover", "cap", {}, "mat", webhook=url)
        jobs.end(c, job, "cancelled")
    return job


def wait_for_log(engine: Engine, job: str) -> str:
    """Wait until a job's log mentions its webhook, and return that line."""
    until(lambda: log_of(engine, job))
    return log_of(engine, job)[-1]


def log_of(engine: Engine, job: str) -> list[str]:
    """The lines of a job's log that mention its webhook."""
    with reading(engine) as c:
        return [row.text for row in jobs.log_lines(c, job, 0, 100) if "webhook" in row.text]


def lease(engine: Engine) -> int:
    with writing(engine) as c:
        token = leases.acquire(c, "here", seize=True)
    assert token is not None
    return token


def test_only_the_coordinator_with_the_lease_sends(engine: Engine) -> None:
    old, new = lease(engine), lease(engine)
    with receiver(lambda n: 200) as found:
        job = ended(engine, found.url)
        with Sender(settings(), engine, lambda: None), Sender(settings(), engine, lambda: old):
            time.sleep(1.5)  # three polls
            assert found.received == []
        with Sender(settings(), engine, lambda: new):
            assert wait_for_log(engine, job) == "webhook, attempt 1: answered with 200"
    with reading(engine) as c:
        assert c.execute(select(table)).all() == []
    assert len(found.received) == 1


def test_redirect_is_said_not_to_be_followed(engine: Engine) -> None:
    token = lease(engine)
    with (
        receiver(lambda n: 301, Location="https://glass.example/") as found,
        Sender(settings(), engine, lambda: token),
    ):
        line = wait_for_log(engine, ended(engine, found.url))
    assert line == "webhook, attempt 1: answered with 301, a redirect, and none is followed; again in 5 s"


def test_delivery_without_answer_is_given_up_after_the_last_attempt(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhook_deliveries, "DELAYS", ())
    token = lease(engine)
    with Sender(settings(), engine, lambda: token):
        job = ended(engine, "http://127.0.0.1:9/")
        assert "no answer: " in (line := wait_for_log(engine, job))
        assert line.endswith("; given up")
    with reading(engine) as c:
        assert c.execute(select(table)).all() == []


def test_nothing_is_sent_to_an_address_that_is_not_public(engine: Engine) -> None:
    token = lease(engine)
    with receiver(lambda n: 200) as found, Sender(settings(private=False), engine, lambda: token):
        line = wait_for_log(engine, ended(engine, found.url))
        assert (
            line
            == "webhook, attempt 1: no answer: 127.0.0.1 is at 127.0.0.1, which is not public; again in 5 s"
        )
        assert found.received == []


def test_long_answer_of_a_receiver_is_logged_in_part(engine: Engine) -> None:
    token = lease(engine)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.recv(1 << 16)
                connection.sendall(b"x" * 60_000 + b"\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        with Sender(settings(), engine, lambda: token):
            line = wait_for_log(engine, ended(engine, f"http://127.0.0.1:{server.getsockname()[1]}/"))
        thread.join()
    assert "no answer: xxxx" in line
    assert len(line) < 300


@pytest.mark.slow
def test_slow_receivers_do_not_delay_others(engine: Engine) -> None:
    token = lease(engine)

    def slow(n: int) -> int:
        time.sleep(3)
        return 200

    with receiver(slow) as slow_one, receiver(lambda n: 200) as found:
        for _ in range(4):
            ended(engine, slow_one.url)
        with Sender(settings(), engine, lambda: token):
            assert wait_for_log(engine, ended(engine, found.url)).endswith("200")
            with reading(engine) as c:
                assert len(c.execute(select(table)).all()) == 4
