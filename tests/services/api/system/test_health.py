"""Health checks: they answer at once, ask rarely, and write nothing."""

import asyncio
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, event

from services.api.system import health
from services.api.system.health import Check, checks
from storage import installation
from storage.objects import marker
from storage.objects.store import Objects


def test_check_that_hangs_answers_with_the_last_result_and_then_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(health, "INTERVAL", 0.0)
    monkeypatch.setattr(health, "SILENCE", 1.0)
    hanging, answers = threading.Event(), threading.Event()
    answers.set()

    def hang() -> str:
        hanging.set()
        answers.wait(60)
        return "ok"

    async def ask() -> None:
        check = Check("hanging", hang)
        while (await check.result()) != "ok":  # a busy machine may take longer than a first answer waits
            pass
        answers.clear()
        hanging.clear()
        start = time.monotonic()
        assert await check.result() == "ok"
        assert hanging.is_set()
        while (found := await check.result()) == "ok":
            assert time.monotonic() - start < 10
        assert found.startswith("no answer for ")
        answers.set()
        while (await check.result()) != "ok":
            assert time.monotonic() - start < 20

    asyncio.run(ask())


def test_checks_run_once_in_an_interval_however_often_they_are_asked_for() -> None:
    runs: list[float] = []

    def check() -> str:
        runs.append(time.monotonic())
        return "ok"

    async def ask() -> None:
        one = Check("counting", check)
        end = time.monotonic() + 2.5 * health.INTERVAL
        while time.monotonic() < end:
            await asyncio.gather(*(one.result() for _ in range(20)))
            await asyncio.sleep(0.01)

    asyncio.run(ask())
    assert 2 <= len(runs) <= 3


async def _results(engine: Engine, objects: Objects) -> dict[str, str]:
    async with asyncio.timeout(60):
        made = checks(engine, objects)
        found = {name: await check.result() for name, check in made.items()}
        while any(text.startswith("no answer") for text in found.values()):
            found = {name: await check.result() for name, check in made.items()}
        return found


def test_checks_write_nothing_and_name_what_fails(
    engine: Engine, objects: Objects, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    executed: list[str] = []

    @event.listens_for(engine, "before_cursor_execute")
    def record(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        executed.append(statement)

    before = sorted((tmp_path / "store").rglob("*"))
    found = asyncio.run(_results(engine, objects))
    assert (found["database"], found["store"]) == ("ok", "ok")
    assert "no coordinator has ever given a sign of life" in found["cluster"]
    assert {statement.split()[0] for statement in executed} == {"BEGIN", "SELECT"}
    assert sorted((tmp_path / "store").rglob("*")) == before
    engine.dispose()
    (tmp_path / "ledger.db").write_bytes(b"not a database, but long enough to be read as one" * 100)
    found = asyncio.run(_results(engine, objects))
    assert found["database"] == found["cluster"] == "DatabaseError; the log of the service has more"
    assert "file is not a database" in caplog.text
    assert "not ready: database: DatabaseError" in caplog.text
    assert "not ready: cluster: DatabaseError" in caplog.text


def test_problem_of_a_store_has_only_the_code_of_the_answer(
    engine: Engine, s3: str, caplog: pytest.LogCaptureFixture
) -> None:
    elsewhere = Objects(s3.replace("envmatte", "another"))
    found = asyncio.run(_results(engine, elsewhere))
    assert found["store"].startswith("the store refuses: NoSuchBucket; check its bucket's name")
    assert "another" not in found["store"]
    assert found["store"] in caplog.text


def test_another_store_than_that_of_the_installation_is_not_ready(
    engine: Engine, objects: Objects, tmp_path: Path
) -> None:
    assert asyncio.run(_results(engine, objects))["store"] == "ok"  # no coordinator has started yet
    id = installation.recognise(engine, Objects((tmp_path / "elsewhere").as_uri()))
    assert id is not None
    found = asyncio.run(_results(engine, objects))["store"]
    assert found.startswith("this machine does not see the store of this installation")  # without its name
    marker.write(objects, id)
    assert asyncio.run(_results(engine, objects))["store"] == "ok"
