"""A backup of a running service is restored into other kinds of stores, and its jobs continue there."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from storage.objects.store import Objects
from tests.end_to_end.conftest import Service, digests, paused, serving
from tests.parts.postgres import Server
from tests.parts.rig import stored
from tests.parts.waiting import until

pytestmark = pytest.mark.slow


def envmatte(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ | environment)


def tiles_done(service: Service, job: str) -> int:
    return int(service.client.job(job)["tiles"]["done"])


@pytest.mark.exhaustive
def test_running_job_continues_in_the_restored_backup(
    capture_archive: Path, s3: str, postgresql_server: Server, tmp_path: Path
) -> None:
    backup, data = str(tmp_path / "backup"), tmp_path / "data"
    with serving(data, "--workers", "1") as first:
        uploaded = first.client.upload(capture_archive)
        first.client.wait(uploaded["job"])
        job = first.client.recover(uploaded["id"], quality="fast")
        until(lambda: tiles_done(first, job["id"]) >= 2)
        with paused(first):
            made = envmatte("backup", backup, "--data", str(data))
            assert made.returncode == 0, made.stderr
            assert "objects" in made.stdout
            assert "backup: 100%" in made.stderr
            verified = envmatte("verify", "--data", str(data))
            assert (verified.returncode, verified.stdout) == (0, "no damage found\n"), verified.stderr
            assert "1 are being written, and were skipped" in verified.stderr
            refused = envmatte("restore", backup, "--data", str(data))
            assert (refused.returncode, "another envmatte serves" in refused.stderr) == (1, True)
        matte = first.client.wait(job["id"])["matte"]
        whole = digests(data / "store" / "mattes" / matte)
    with postgresql_server.database() as database:
        where = ("--data", str(tmp_path / "other"), "--database", database, "--store", s3)
        restored = envmatte("restore", backup, *where, "--json")
        assert restored.returncode == 0, restored.stderr
        assert json.loads(restored.stdout)["objects"] > 20
        with serving(tmp_path / "other", "--workers", "1", "--database", database, "--store", s3) as second:
            assert tiles_done(second, job["id"]) >= 2
            ended = second.client.wait(job["id"])
            assert (ended["state"], ended["matte"]) == ("succeeded", matte)
            assert stored(Objects(s3), f"mattes/{matte}") == whole
            assert second.client.capture(uploaded["id"])["name"] == "ball"
            chunk = f"mattes/{matte}/S/c/0/0/0"
            data_of = bytearray(Objects(s3).read_raw(chunk))
            data_of[9] ^= 1
            Objects(s3).write_raw(chunk, iter([bytes(data_of)]))
            verified = envmatte("verify", *where, "--json")
            report = json.loads(verified.stdout)
            assert (verified.returncode, report["read"]["unchecked"]) == (1, 0)
            assert [(one["what"], one["object"]) for one in report["findings"]] == [("damaged", chunk)]
            problem = second.http.get(f"/v1/mattes/{matte}/layers/S.png")
            assert problem.status_code == 500
            assert chunk in problem.json()["detail"]
