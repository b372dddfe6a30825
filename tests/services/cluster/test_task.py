"""What a worker logs about steps that fail."""

import logging
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest

from services.cluster import task as module
from storage.errors import Corrupt, EnvmatteError, InvalidInput, NoRoom, StoreUnavailable, WrongStore
from storage.objects import marker
from storage.objects.store import Objects
from workflows.jobs import Task
from workflows.mattes.steps import STEPS
from workflows.untrusted.limits import Limits


@pytest.mark.parametrize(
    ("error", "logged"),
    [(NoRoom, [None]), (StoreUnavailable, [None]), (Corrupt, [Corrupt]), (InvalidInput, [])],
)
def test_only_what_its_text_does_not_explain_has_a_traceback(
    error: type[EnvmatteError],
    logged: list[type[EnvmatteError] | None],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def work(objects: Objects, task: Task, tile: int) -> int:
        raise error("for a reason")

    task = Task("a", "none", "none", {}, Limits(1 << 30, 1 << 26))
    with caplog.at_level(logging.INFO, "services.cluster.task"), pytest.raises(error):
        module._run(0, replace(STEPS, work=work), tmp_path.as_uri(), task, None)
    raised = [record.exc_info[0] if record.exc_info else None for record in caplog.records]
    assert raised == logged
    assert all("for a reason" in record.getMessage() for record in caplog.records)


def test_a_worker_looks_for_the_store_until_it_sees_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BLIND", 0.3)
    worked: list[int] = []

    def work(objects: Objects, task: Task, tile: int) -> int:
        worked.append(tile)
        return 1

    task = Task("a", "none", "none", {}, Limits(1 << 30, 1 << 26))
    given = replace(STEPS, work=work), tmp_path.as_uri(), task, None, "this one"
    start = time.monotonic()
    with pytest.raises(WrongStore, match=f"the worker on {socket.gethostname()} does not see"):
        module._run(0, *given)
    assert time.monotonic() - start > module.BLIND  # others take what is to do meanwhile
    marker.write(Objects(tmp_path.as_uri()), "this one")
    module._run(1, *given)
    assert worked == [1]


@pytest.mark.parametrize("fails", [False, True])
def test_a_step_during_which_the_folder_is_unmounted_does_not_count(
    fails: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BLIND", 0)
    store = tmp_path / "store"
    marker.write(Objects(store.as_uri()), "this one")

    def work(objects: Objects, task: Task, tile: int) -> int:
        store.rename(tmp_path / "unmounted")
        if fails:
            raise Corrupt("matte none is not in the store")
        return 1

    task = Task("a", "none", "none", {}, Limits(1 << 30, 1 << 26))
    with pytest.raises(WrongStore, match=f"the worker on {socket.gethostname()} does not see"):
        module._run(0, replace(STEPS, work=work), store.as_uri(), task, None, "this one")


def test_a_worker_that_cannot_make_the_folder_of_the_store_does_not_see_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BLIND", 0)
    (tmp_path / "file").touch()
    task = Task("a", "none", "none", {}, Limits(1 << 30, 1 << 26))
    with pytest.raises(WrongStore, match=f"the worker on {socket.gethostname()}: cannot open the store"):
        module._run(0, STEPS, (tmp_path / "file" / "store").as_uri(), task, None)
