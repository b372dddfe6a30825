"""A cluster on a bucket makes the same bytes as a single machine on a folder; a bucket that refuses is named."""

import os
import shutil
from pathlib import Path

import pytest

from services.client import Busy, _session
from services.runtime import certificates
from storage.objects.store import Objects
from tests.end_to_end.conftest import Service, digests, serving
from tests.parts.rig import stored
from tests.parts.waiting import until
from tests.services.cluster.clusters import address, started

ZIP = {"Content-Type": "application/zip"}


@pytest.mark.exhaustive
@pytest.mark.slow
def test_matte_is_the_same_in_a_bucket_and_in_a_folder(
    service: Service, matte: str, capture_archive: Path, s3: str, tmp_path: Path
) -> None:
    folder = tmp_path / "certs"
    certificates.make(folder)
    log = tmp_path / "log"
    with started(log, "scheduler", "--port", "0", "--certs", str(folder)) as scheduler:
        at = address(scheduler)
        named = ("--cluster", at, "--certs", str(folder))
        with (
            started(log, "worker", *named, "--workers", "2"),
            serving(tmp_path / "data", *named, "--store", s3) as remote,
        ):
            uploaded = remote.client.upload(capture_archive)
            remote.client.wait(uploaded["job"])
            made = remote.client.wait(remote.client.recover(uploaded["id"])["id"])["matte"]
            objects = Objects(s3)
            in_bucket = stored(objects, f"mattes/{made}")
            assert in_bucket == digests(service.data / "store" / "mattes" / matte)
            assert objects.names("uploads") == []
            assert not (tmp_path / "data" / "store").exists()
            assert remote.http.delete(f"/v1/mattes/{made}").status_code == 204
            assert made not in objects.names("mattes")


def test_a_store_that_refuses_is_named_to_all_who_ask(
    capture_archive: Path, s3: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_session, "PATIENCE", 1.0)
    with serving(tmp_path / "data", "--store", s3, "--workers", "1"):
        pass  # later starts don't wait for a store that is away
    where = ("--store", s3.replace("envmatte", "another"), "--workers", "1")
    with serving(tmp_path / "data", *where) as service:
        ready = service.http.get("/readyz")
        assert (ready.status_code, ready.json()["database"]) == (503, "ok")
        assert ready.json()["store"].startswith("the store refuses: NoSuchBucket;")
        with pytest.raises(Busy, match="the store refuses: NoSuchBucket;") as refused:
            service.client.upload(capture_archive)
        assert refused.value.retry_after == 2
        until(lambda: "housekeeping is tried again later: the store refuses" in service.log())
        assert "Traceback" not in service.log()


def test_an_api_alone_says_where_it_is_and_which_variables_it_does_not_know(tmp_path: Path) -> None:
    command = ("serve", "--port", "0", "--data", str(tmp_path), "--store", (tmp_path / "other").as_uri())
    settings = {"ENVMATTE_COORDINATE": "false", "ENVMATTE_STROE_BYTES": "1"}
    with started(tmp_path / "log", *command, **settings) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("envmatte serves at http://127.0.0.1:")
        assert (tmp_path / "log").read_text().count("ignored: ENVMATTE_STROE_BYTES;") == 1


@pytest.mark.slow
def test_a_share_that_is_unmounted_for_a_while_fails_no_job_and_takes_no_upload(
    capture_archive: Path, tmp_path: Path
) -> None:
    share, away = tmp_path / "share", tmp_path / "away"
    with serving(tmp_path / "data", "--store", share.as_uri(), "--workers", "1") as service:
        capture = service.client.upload(capture_archive)
        service.client.wait(capture["job"])
        job = service.client.recover(capture["id"], tile=16)["id"]
        until(lambda: service.client.job(job)["tiles"]["done"] > 1)
        share.rename(away)
        share.mkdir()
        frame, body = f"/v1/captures/{capture['id']}/frames/0.png", capture_archive.read_bytes()
        refused = service.http.get(frame), service.http.post("/v1/captures", content=body, headers=ZIP)
        for answer in refused:
            assert (answer.status_code, answer.json()["type"]) == (503, "urn:envmatte:problem:unavailable")
            assert "does not see the store of this installation" in answer.json()["detail"]
        until(lambda: service.client.job(job)["waits_for"])
        assert not (share / "uploads").exists()
        shutil.rmtree(share)
        away.rename(share)
        assert service.client.wait(job)["state"] == "succeeded"
        assert service.http.get(frame).status_code == 200
        assert "Traceback" not in service.log()


BLINDED = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"')
"""Runs a command that sees an empty folder in place of another, as on a machine where a share is not mounted."""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can mount")
@pytest.mark.slow
def test_a_machine_that_does_not_see_the_store_fails_no_job(capture_archive: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir()
    with started(tmp_path / "scheduler.log", "scheduler", "--port", "0") as scheduler:
        named = ("--cluster", address(scheduler))
        where = (*named, "--store", store.as_uri())
        blind, sees = tmp_path / "blind.log", tmp_path / "sees.log"
        of_worker = ("worker", *named, "--workers", "1")
        with serving(tmp_path / "data", *where) as service, started(sees, *of_worker):
            with started(blind, *of_worker, within=(*BLINDED, str(store))):
                until(lambda: len(service.http.get("/v1/cluster").json()["workers"]) == 2)
                uploaded = service.client.upload(capture_archive)
                service.client.wait(uploaded["job"])
                job = service.client.recover(uploaded["id"])
                assert service.client.wait(job["id"])["state"] == "succeeded"
            complaint = "does not see the store of this installation"
            assert complaint in blind.read_text()
            assert complaint in service.log()
            assert complaint not in sees.read_text()
            assert service.http.get("/readyz").json()["store"] == "ok"
            store.rename(tmp_path / "unmounted")
            store.mkdir()
            until(lambda: complaint in service.http.get("/readyz").json()["store"])
        with started(
            tmp_path / "again.log", "serve", "--port", "0", "--data", str(tmp_path / "data"), *where
        ) as again:
            assert again.wait(60) == 1
        assert complaint in (tmp_path / "again.log").read_text()
