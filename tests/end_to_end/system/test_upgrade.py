"""A data folder of version 0.1.0 opens with this version, and its unfinished jobs continue.

``version_0_1_0.tar.xz`` holds the folder as ``envmatte serve`` of 0.1.0 left it when it was killed (SIGKILL) during a
recovery: a capture of 32 x 32 pixels, a finished matte, a recovery with one of four tiles done, a queued recovery, a
finished resumable upload without a capture, and an API key. With it come ``facts.json`` (the ids, the key, and SHA-256
of matte archives that 0.1.0 exported) and ``backdrop.png`` with the ``composite.png`` that 0.1.0 made of the finished
matte. The folder names no path outside of itself, so it can be unpacked anywhere. Left out are the workers' scratch
folders, the lock file and SQLite's shared memory, which every start creates again; the write-ahead log is there.
"""

import hashlib
import json
import sqlite3
import tarfile
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx2
import imagecodecs
import numpy as np
import pytest

from services.client import Client
from tests.end_to_end.conftest import digests, serving

PACKED = Path(__file__).parents[2] / "storage" / "database" / "version_0_1_0.tar.xz"
TILES = 4


@pytest.fixture
def facts(tmp_path: Path) -> dict[str, Any]:
    """What is known of the folder, after unpacking it."""
    with tarfile.open(PACKED) as packed:
        packed.extractall(tmp_path, filter="data")
    found: dict[str, Any] = json.loads((tmp_path / "facts.json").read_text())
    return found


def done_tiles(data: Path, job: str) -> list[int]:
    """The tiles of a job that the old version finished, from the database and its write-ahead log."""
    with closing(sqlite3.connect(data / "envmatte.db")) as connection:
        query = "SELECT tile FROM tiles WHERE job = ? AND tile >= 0 AND state = 'done'"
        return [tile for (tile,) in connection.execute(query, (job,))]


def exported(client: Client, matte: str, target: Path) -> str:
    client.export(matte, target)
    return hashlib.sha256(target.read_bytes()).hexdigest()


@pytest.mark.slow
def test_folder_of_0_1_0_opens_and_its_jobs_continue(facts: dict[str, Any], tmp_path: Path) -> None:
    data = tmp_path / "data"
    interrupted = data / "store" / "mattes" / facts["interrupted_matte"]
    done = done_tiles(data, facts["interrupted"])
    assert 0 < len(done) < TILES
    blocks = [divmod(tile, 2) for tile in done]
    of_done = [f"/c/{row}/{column}" for row, column in blocks] + [
        f"T/{row}.{column}" for row, column in blocks
    ]
    before = digests(interrupted)
    with serving(data, "--workers", "1") as service:
        assert httpx2.get(f"{service.url}/v1/jobs").status_code == 401  # the key is still required
        with Client(service.url, facts["key"]) as client:
            # The finished matte.
            assert client.matte(facts["ready"]).name == client.capture(facts["capture"]).name != ""
            assert exported(client, facts["ready"], tmp_path / "ready.zip") == facts["ready_sha256"]
            composite = client.composite(facts["ready"], tmp_path / "backdrop.png")
            pixels, expected = (
                imagecodecs.png_decode(png).astype(int)
                for png in (composite, (tmp_path / "composite.png").read_bytes())
            )
            # Processors of different kinds may round a value to the next code.
            np.testing.assert_allclose(pixels, expected, rtol=0, atol=1)
            # The jobs.
            assert client.wait(facts["queued"])["state"] == "succeeded"
            ended = client.wait(facts["interrupted"])
            assert ended["tiles"] == {"total": TILES, "done": TILES, "failed": 0}
            # The upload.
            headers = {"Authorization": f"Bearer {facts['key']}"}
            made = service.http.post("/v1/captures", json={"upload": facts["upload"]}, headers=headers)
            assert made.status_code == 201, made.text
            assert client.wait(made.json()["job"])["state"] == "succeeded"
            # Old tiles are kept; new ones equal those of a recovery from the start with the options that 0.1.0 chose,
            # some of which have another default now.
            options = client.job(facts["interrupted"])["options"]
            fresh = client.wait(client.recover(facts["capture"], **options)["id"])["matte"]
            found, again = digests(interrupted), digests(data / "store" / "mattes" / fresh)
            assert found.keys() == again.keys()
            for name, digest in found.items():
                expected_digests = before if any(part in name for part in of_done) else again
                assert digest == expected_digests[name], name
