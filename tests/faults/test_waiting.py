"""A job that cannot continue says what it waits for, and continues as soon as it can."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.client import Client
from tests.faults.conftest import Prepared
from tests.parts.rig import Rig
from tests.parts.waiting import until

pytestmark = [pytest.mark.exhaustive, pytest.mark.timeout(900)]


def waits_for(rig: Rig, job: str, words: str) -> Callable[[], bool]:
    return lambda: words in (rig.job(job)["waits_for"] or "")


def test_waits_for_workers(prepared: Prepared) -> None:
    rig = prepared.rig
    for n in range(2):
        rig.kill(f"worker{n}")
    until(lambda: not rig.ask("GET", "/v1/jobs?limit=1").json()["jobs"][0]["workers"])
    job = rig.recover(prepared.capture)
    until(waits_for(rig, job["id"], "no worker is connected"))
    until(lambda: "no worker" in rig.ask("GET", "/readyz", repeat=False).json()["cluster"])
    assert rig.ask("GET", "/readyz", repeat=False).status_code == 503
    for n in range(2):
        rig.start(f"worker{n}")
    prepared.check_continues(job["id"], job["matte"])


def test_waits_for_the_scheduler(prepared: Prepared) -> None:
    rig = prepared.rig
    job = rig.recover(prepared.capture)
    rig.kill("scheduler")
    until(waits_for(rig, job["id"], "no scheduler answers"))
    rig.start("scheduler")
    prepared.check_continues(job["id"], job["matte"])


def test_waits_for_a_coordinator(prepared: Prepared) -> None:
    rig = prepared.rig
    for n in range(2):
        rig.kill(f"service{n}")
    with rig.api_alone() as url:
        job = rig.ask("POST", "/v1/jobs", json={"capture": prepared.capture}, at=url).json()
        here = f"/v1/jobs/{job['id']}"
        until(lambda: "no coordinator" in (rig.ask("GET", here, at=url).json()["waits_for"] or ""))
    for n in range(2):
        rig.start(f"service{n}")
    prepared.check_continues(job["id"], job["matte"])


def test_waits_for_capture_and_for_other_jobs(prepared: Prepared, archive_bytes: bytes) -> None:
    rig = prepared.rig
    uploaded = rig.ask(
        "POST", "/v1/captures", content=archive_bytes, headers={"Content-Type": "application/zip"}
    ).json()
    job = rig.recover(uploaded["id"])
    assert f"its capture {uploaded['id']} is being ingested" in job["waits_for"]
    other = rig.recover(prepared.capture)
    until(waits_for(rig, other["id"], "shares 2 workers with"))
    for one in (job, other):
        prepared.check_continues(one["id"], one["matte"])


def test_waiting_client_survives_a_restart_of_the_service(prepared: Prepared) -> None:
    rig = prepared.rig
    with Client(rig.urls[0]) as client, ThreadPoolExecutor(1) as pool:
        job = client.recover(prepared.capture)
        waiting = pool.submit(client.wait, job["id"])
        rig.restart("service0")
        assert waiting.result(240)["state"] == "succeeded"
    prepared.check_continues(job["id"], job["matte"])
