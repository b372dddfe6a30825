"""Uploads resume after broken connections and kills, also with other tus clients."""

import base64
import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import httpx2
import numpy as np
import pytest

from services.client import Client
from storage.database.engine import open_engine
from storage.layout import uploads as stored_uploads
from storage.objects.store import Objects
from storage.records import uploads
from tests.end_to_end.captures.tus import (
    CHUNK,
    TUS,
    begin_patch,
    create,
    offset_of,
    uploads_of,
    wait_until_deleted,
)
from tests.end_to_end.conftest import Service, paused, serving
from tests.end_to_end.lines import Line
from tests.parts.processes import interrupt, running
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

MB = 1_000_000
SIZES = [50 * MB, pytest.param(1000 * MB, marks=[pytest.mark.exhaustive, pytest.mark.timeout(1800)])]


def large(capture_archive: Path, path: Path, size: int) -> Path:
    """The scene's capture archive, enlarged to a size by an entry of noise."""
    shutil.copy(capture_archive, path)
    rng = np.random.default_rng(size)
    with zipfile.ZipFile(path, "a") as archive, archive.open("film.raw", "w", force_zip64=True) as entry:
        for _ in range(-(-size // MB)):
            entry.write(rng.bytes(MB))
    return path


def digest_of(service: Service, upload: str) -> str:
    """SHA-256 of the bytes that the store has of an upload."""
    objects = Objects((service.data / "store").as_uri())
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    with engine.connect() as c:
        parts = uploads.parts_of(c, upload)
    engine.dispose()
    digest = hashlib.sha256()
    if parts:  # otherwise it belongs to a capture and has an index
        for part in parts:
            digest.update((service.data / "store" / stored_uploads.part_path(upload, part.name)).read_bytes())
    else:
        with stored_uploads.read(objects, upload) as file:
            while data := file.read(MB):
                digest.update(data)
    return digest.hexdigest()


def sha256(file: Path) -> str:
    with file.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


@pytest.mark.parametrize("size", SIZES)
def test_client_survives_a_hundred_broken_connections(
    service: Service, capture_archive: Path, tmp_path: Path, size: int
) -> None:
    file = large(capture_archive, tmp_path / "large.zip", size)
    sent_so_far: list[int] = []
    with Line(service.url, cuts=100, mean=size // 200, back=True, seed=1) as line, Client(line.url) as client:
        with paused(service):
            made = client.upload(file, progress=lambda sent, whole: sent_so_far.append(sent))
            assert line.made == 100
            assert made["bytes"] == file.stat().st_size
            assert digest_of(service, made["id"]) == sha256(file)
        assert sent_so_far == sorted(set(sent_so_far))
        assert sent_so_far[-1] == file.stat().st_size
    assert service.client.wait(made["job"])["state"] == "succeeded"
    wait_until_deleted(service, made["id"])


@pytest.mark.parametrize("size", SIZES)
def test_bytes_sent_before_each_broken_connection_are_kept(
    service: Service, tmp_path: Path, size: int
) -> None:
    file = tmp_path / "noise"
    file.write_bytes(np.random.default_rng(size).bytes(size))
    where = create(service, size)
    offset = begun = 0
    with (
        Line(service.url, cuts=100, mean=size // 150, seed=2) as line,
        httpx2.Client(base_url=line.url, timeout=300) as http,
        file.open("rb") as source,
    ):
        while offset < size:
            try:
                found = int(http.head(where, headers=TUS).headers["upload-offset"])
                assert found >= offset
                offset = begun = found
                source.seek(offset)
                headers = CHUNK | {"Upload-Offset": str(offset), "Content-Length": str(size - offset)}
                answer = http.patch(where, headers=headers, content=iter(lambda: source.read(MB), b""))
                assert answer.status_code in (204, 409)  # earlier bytes may be recorded only now
                offset = int(answer.headers.get("upload-offset", offset))
            except httpx2.TransportError:
                continue
        assert line.made == 100
        # Each PATCH sent all that was left: if bytes before a cut were dropped, the last would have begun at 0.
        assert begun > size // 10
    upload = where.rsplit("/", 1)[1]
    assert digest_of(service, upload) == sha256(file)
    assert service.http.delete(where, headers=TUS).status_code == 204
    assert not [name for name in uploads_of(service) if upload in name]


@pytest.mark.exhaustive
def test_upload_resumes_after_the_server_is_killed(capture_archive: Path, tmp_path: Path) -> None:
    data, file = tmp_path / "data", large(capture_archive, tmp_path / "large.zip", 50 * MB)
    made: list[dict] = []
    sent_so_far: list[int] = []
    half = threading.Event()

    def progress(sent: int, whole: int) -> None:
        sent_so_far.append(sent)
        if sent > whole // 3:
            half.set()

    with Line("http://127.0.0.1:9", pace=0.01) as line, Client(line.url) as client:
        with serving(data, "--workers", "1") as first:
            line.target = first.url
            sender = threading.Thread(target=lambda: made.append(client.upload(file, progress=progress)))
            sender.start()
            assert half.wait(60)
            # An upload that no client continues, killed in the middle of its first part.
            other = create(first, 1000 * MB)
            busy = begin_patch(first, other, 0, 1000 * MB, bytes(20 * MB))
            until(lambda: any("#" in name for name in uploads_of(first) if other.rsplit("/", 1)[1] in name))
            first.kill()
            busy.close()
            reached = sent_so_far[-1]
        with serving(data, "--workers", "1") as second:
            assert offset_of(second, other) == 0
            assert not [name for name in uploads_of(second) if other.rsplit("/", 1)[1] in name]
            line.target, carried = second.url, line.carried
            sender.join(120)
            assert made
            assert sent_so_far == sorted(set(sent_so_far))
            assert line.carried - carried < file.stat().st_size - reached + MB
            assert second.client.wait(made[0]["job"])["state"] == "succeeded"
            assert second.http.delete(other, headers=TUS).status_code == 204
            wait_until_deleted(second, made[0]["id"])
            assert not uploads_of(second)


def test_interrupted_upload_command_resumes_when_run_again(
    service: Service, capture_archive: Path, tmp_path: Path
) -> None:
    file = large(capture_archive, tmp_path / "large.zip", 50 * MB)
    with Line(service.url, pace=0.01) as line:
        command = [sys.executable, "-m", "services", "upload", str(file), "--url", line.url]
        with running(command) as sending:
            assert sending.stderr is not None
            while "upload: " not in (shown := sending.stderr.readline()) or "upload: 0%" in shown:
                assert sending.poll() is None
            assert interrupt(sending)[0] == 130
        before = line.carried
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        assert "upload: 100%" in done.stderr
        assert line.carried - before < 0.85 * file.stat().st_size
    assert service.client.capture(done.stdout.strip())["bytes"] == file.stat().st_size


def test_file_that_shrinks_during_the_upload_is_reported(
    service: Service, capture_archive: Path, tmp_path: Path
) -> None:
    file = large(capture_archive, tmp_path / "large.zip", 20 * MB)

    def shrink(sent: int, whole: int) -> None:
        os.truncate(file, 1000)

    with pytest.raises(Exception, match="shorter"):
        service.client.upload(file, progress=shrink)


# In its own process, because it leaves sockets and files to the garbage collector.
TUSPY = """
import json, sys
from tusclient.client import TusClient
options = json.loads(sys.argv[1])
client = TusClient(options["endpoint"])
more = {"upload_checksum": options["checksum"], "metadata": {"filename": "ball.zip"}}
first = client.uploader(options["file"], chunk_size=50_000, **more)
half = first.get_file_size() // 2
first.upload(stop_at=half)
second = client.uploader(options["file"], chunk_size=2 * half, url=first.url, **more)
assert half <= second.offset < 2 * half
second.upload()
print(first.url)
"""


@pytest.mark.parametrize("checksum", [False, True])
def test_tuspy_uploads(service: Service, capture_archive: Path, checksum: bool) -> None:
    arguments = {"file": str(capture_archive), "endpoint": f"{service.url}/v1/uploads", "checksum": checksum}
    command = [sys.executable, "-c", TUSPY, json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    check_sent(service, done.stdout.strip(), capture_archive)


def check_sent(service: Service, url: str, file: Path) -> None:
    """Check that an upload equals a file and becomes a capture."""
    upload = url.rsplit("/", 1)[1]
    assert digest_of(service, upload) == sha256(file)
    metadata = service.http.head(f"/v1/uploads/{upload}", headers=TUS).headers["upload-metadata"]
    assert f"filename {base64.b64encode(b'ball.zip').decode()}" in metadata
    made = service.http.post("/v1/captures", json={"upload": upload}).json()
    assert service.client.wait(made["job"])["state"] == "succeeded"


@pytest.fixture(scope="module")
def tus_js(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with tus-js-client in it."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("node and npm are not installed: tus-js-client can't be run")
    folder = tmp_path_factory.mktemp("node")
    (folder / "package.json").write_text("{}")
    command = [npm, "install", "--silent", "--no-audit", "--no-fund", "tus-js-client@4"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    if done.returncode:
        pytest.skip(f"npm could not install tus-js-client: {done.stderr.strip()[-200:]}")
    return folder


SCRIPT = """
const fs = require("fs"), tus = require("tus-js-client");
const { file, endpoint, chunk, during, stop } = JSON.parse(process.argv[2]);
let stopped = false;
const upload = new tus.Upload(fs.createReadStream(file), {
  endpoint, chunkSize: chunk ?? Infinity, uploadSize: fs.statSync(file).size,
  uploadDataDuringCreation: during, metadata: { filename: "ball.zip", filetype: "application/zip" },
  retryDelays: [100, 200, 400],
  onError(error) { console.error(String(error)); process.exit(1); },
  onChunkComplete(size, sent, whole) {
    if (!stop || stopped || sent < whole / 2) return;
    stopped = true;
    upload.abort().then(() => {
      const again = new tus.Upload(fs.readFileSync(file), {
        endpoint, uploadUrl: upload.url, onError: upload.options.onError,
        onSuccess() { console.log(upload.url); },
      });
      again.start();
    });
  },
  onSuccess() { console.log(upload.url); },
});
upload.start();
"""


@pytest.mark.parametrize(
    "options",
    [{}, {"chunk": 50_000}, {"chunk": 50_000, "during": True}, {"chunk": 50_000, "stop": True}],
    ids=["whole", "chunks", "with creation", "aborted and resumed"],
)
def test_tus_js_client_uploads(service: Service, capture_archive: Path, tus_js: Path, options: dict) -> None:
    arguments = {"file": str(capture_archive), "endpoint": f"{service.url}/v1/uploads"} | options
    command = ["node", "-e", SCRIPT, "tus", json.dumps(arguments)]
    done = subprocess.run(command, cwd=tus_js, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    check_sent(service, done.stdout.strip(), capture_archive)
