"""The client against web servers that answer as a test says."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from services import client as package
from services.client import Client, FileChanged, JobFailed, NotFound, ServiceError
from tests.services.client.servers import JOB, ok, refusal, scripted_server

HEAVY = (
    "httpx2",
    "numpy",
    "OpenEXR",
    "numba",
    "scipy",
    "zarr",
    "dask",
    "distributed",
    "fastapi",
    "sqlalchemy",
)


@pytest.mark.parametrize(
    ("module", "more"),
    [
        ("services.client", {"click", "storage", "workflows"}),
        ("services.cli.main", {"storage.database", "workflows.recovery"}),
    ],
)
def test_import_loads_nothing_heavy(module: str, more: set[str]) -> None:
    script = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not set(found.stdout.split()) & {*HEAVY, *more}


def test_upload_to_an_unreachable_service_fails_at_once(tmp_path: Path) -> None:
    (tmp_path / "any.zip").write_bytes(b"any")
    with Client("http://127.0.0.1:9") as client, pytest.raises(ServiceError, match="envmatte serve"):
        client.upload(tmp_path / "any.zip")


def test_wait_reports_progress_and_the_outcome() -> None:
    states = [{}, {"progress": 0.75}, {"state": "succeeded", "progress": 1.0}]
    seen: list[float] = []
    with scripted_server(lambda n: ok(JOB | states[n])) as (url, _), Client(url) as client:
        done = client.wait("j", progress=lambda job: seen.append(job.progress), poll=0.01)
    assert (seen, done.ended, done["news"]) == ([0.5, 0.75, 1.0], True, "of a later version")
    problem = {"title": "t", "status": 500, "detail": "tile 3 failed"}
    with (
        scripted_server(lambda n: ok(JOB | {"state": "failed", "problem": problem})) as (url, _),
        Client(url) as client,
        pytest.raises(JobFailed, match="tile 3 failed") as caught,
    ):
        client.wait("j")
    assert caught.value.job.id == "j"


def test_retried_delete_succeeds_if_the_first_attempt_did() -> None:
    with (
        scripted_server(lambda n: (ok(), None, refusal(404), refusal(404))[n]) as (url, calls),
        Client(url) as client,
    ):
        job = client.job("j")
        client.delete(job)
        with pytest.raises(NotFound):
            client.delete(job)
    assert [call["call"] for call in calls[1:]] == ["DELETE /v1/jobs/j"] * 3


def test_an_id_reaches_no_other_path() -> None:
    with scripted_server(lambda n: ok()) as (url, calls), Client(url) as client:
        for id in ("../captures", "a/b", "a b?c#d%2F"):
            client.job(id)
        for id in ("", ".", ".."):
            with pytest.raises(NotFound, match="is not an id"):
                client.cancel(id)
            with pytest.raises(NotFound, match="is not an id"):
                client.recover(id)
    ids = ["..%2Fcaptures", "a%2Fb", "a%20b%3Fc%23d%252F"]
    assert [call["call"] for call in calls] == [f"GET /v1/jobs/{id}" for id in ids]


@pytest.mark.parametrize("size", [100_000, 300_000])
def test_an_archive_that_changes_while_it_is_sent(tmp_path: Path, size: int) -> None:
    """One that becomes shorter is an error; of one that grows, what was announced is sent."""
    archive = tmp_path / "matte.zip"
    archive.write_bytes(bytes(200_000))
    matte = JOB | {"job": None, "width": 1, "height": 1, "monitor": [1, 1]}
    with scripted_server(lambda n: ok(matte)) as (url, calls), Client(url) as client:

        def change() -> object:
            return client.import_matte(archive, progress=lambda sent, of: os.truncate(archive, size))

        if size < 200_000:
            with pytest.raises(FileChanged, match="became shorter"):
                change()
        else:
            change()
            assert [len(call["body"]) for call in calls] == [200_000]


def test_package_is_marked_as_typed() -> None:
    assert Path(package.__file__).parents[1].joinpath("py.typed").is_file()


@pytest.mark.parametrize("region", [(1, 2), (1, 2, 3, 4, 5), 1])
def test_a_region_that_is_not_four_numbers_is_refused(region: Any) -> None:
    with scripted_server(lambda n: ok()) as (url, calls), Client(url) as client:
        for ask in (lambda: client.recover("c", region=region), lambda: client.recover_first("j", region)):
            with pytest.raises(ValueError, match=r"a region is \(x, y, width, height\)"):
                ask()
    assert not calls
