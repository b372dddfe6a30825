"""A job that can't go on says in words what it waits for, and goes on as soon as it can."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.client import Client
from tests.faults.conftest import Known
from tests.faults.rig import Rig
from tests.services.clusters import wait

pytestmark = [pytest.mark.full, pytest.mark.timeout(900)]


def says(rig: Rig, job: str, words: str) -> Callable[[], bool]:
    return lambda: words in (rig.job(job)["waits_for"] or "")


def goes_on(known: Known, job: str, matte: str) -> None:
    assert known.rig.ended(job)["state"] == "succeeded"
    assert known.rig.job(job)["waits_for"] is None
    assert known.rig.files(matte) == known.files


@pytest.mark.long
def test_without_workers(known: Known) -> None:
    rig = known.rig
    for n in range(2):
        rig.kill(f"worker{n}")
    wait(lambda: not rig.ask("GET", "/v1/jobs?limit=1").json()["jobs"][0]["workers"])
    job = rig.recover(known.capture)
    wait(says(rig, job["id"], "no worker is connected"))
    ready = rig.ask("GET", "/readyz", repeat=False)
    assert (ready.status_code, "no worker" in ready.json()["cluster"]) == (503, True)
    for n in range(2):
        rig.start(f"worker{n}")
    goes_on(known, job["id"], job["matte"])


@pytest.mark.long
def test_without_a_scheduler(known: Known) -> None:
    rig = known.rig
    job = rig.recover(known.capture)
    rig.kill("scheduler")
    wait(says(rig, job["id"], "no scheduler answers"))
    rig.start("scheduler")
    goes_on(known, job["id"], job["matte"])


@pytest.mark.long
def test_without_a_coordinator(known: Known) -> None:
    rig = known.rig
    for n in range(2):
        rig.kill(f"service{n}")
    with rig.api_alone() as url:
        job = rig.ask("POST", "/v1/jobs", json={"capture": known.capture}, at=url).json()
        here = f"/v1/jobs/{job['id']}"
        wait(lambda: "no coordinator" in (rig.ask("GET", here, at=url).json()["waits_for"] or ""))
    for n in range(2):
        rig.start(f"service{n}")
    goes_on(known, job["id"], job["matte"])


@pytest.mark.long
def test_for_its_capture_and_beside_others(known: Known, bundle_bytes: bytes) -> None:
    rig = known.rig
    uploaded = rig.ask(
        "POST", "/v1/captures", content=bundle_bytes, headers={"Content-Type": "application/zip"}
    ).json()
    job = rig.recover(uploaded["id"])
    assert f"its capture {uploaded['id']} is being ingested" in job["waits_for"]
    other = rig.recover(known.capture)
    wait(says(rig, other["id"], "shares 2 workers with"))
    for one in (job, other):
        goes_on(known, one["id"], one["matte"])


@pytest.mark.long
def test_a_client_that_waits_outlives_its_service(known: Known) -> None:
    rig = known.rig
    with Client(rig.urls[0]) as client, ThreadPoolExecutor(1) as pool:
        job = client.recover(known.capture)
        waiting = pool.submit(client.wait, job["id"])
        rig.restart("service0")
        assert waiting.result(240)["state"] == "succeeded"
    goes_on(known, job["id"], job["matte"])


def test_a_cancelled_job_frees_its_workers_and_what_it_wrote(known: Known) -> None:
    rig = known.rig
    # One tile of nn-dgsr that takes minutes.
    options = {"method": "nn-dgsr", "tile": 1024}
    job = rig.ask("POST", "/v1/jobs", json={"capture": known.capture, "options": options}).json()
    wait(lambda: rig.job(job["id"])["stage"] == "recovering")
    time.sleep(1)
    cancelled = rig.ask("POST", f"/v1/jobs/{job['id']}/cancel").json()
    assert cancelled["state"] == "cancelled"
    wait(lambda: not rig.names(job["matte"]), 10)
    assert rig.ask("GET", f"/v1/mattes/{job['matte']}").status_code == 404
    after = rig.recover(known.capture)
    goes_on(known, after["id"], after["matte"])
    assert not rig.names(job["matte"])
