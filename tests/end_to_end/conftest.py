"""A real service in its own process, and captures to send to it."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
import psutil
import pytest

from services.client import Client
from storage.objects.checksums import SUFFIX
from tests.parts.background import repeating
from tests.parts.captures import nested_program
from tests.parts.waiting import until
from tests.services.cluster.clusters import workers
from workflows.images import integer_formats
from workflows.images.tone_curves import from_light
from workflows.programs.program import Program
from workflows.simulation import glass_ball
from workflows.simulation.scene import Scene, write_capture

BANDS = ((8, 6, 16), (16, 12, 16), (32, 24, 20))
WIDTH, HEIGHT = 64, 48
"""Pixels of the scene."""
TILES = 12
"""Of the scene's recovery, unless another size of tiles is asked for."""


@dataclass
class Service:
    """A running `envmatte serve`."""

    process: subprocess.Popen[str]
    data: Path
    url: str
    client: Client
    http: httpx2.Client

    def kill(self) -> None:
        """End the server as a crash would; its workers must notice by themselves."""
        self.process.kill()
        self.process.wait(120)

    def log(self) -> str:
        """What it and its processes have logged."""
        return log_of(self.data).read_text()

    def stored(self) -> set[str]:
        """Every file of the store that belongs to an upload, a capture or a matte; checksums count with their file."""
        store = self.data / "store"
        # os.walk skips folders that are deleted meanwhile.
        files = [
            Path(folder, name).relative_to(store) for folder, _, names in os.walk(store) for name in names
        ]
        found = {str(path) for path in files if len(path.parts) > 2 or path.parts[0] == "uploads"}
        return {
            path
            for path in found
            if path.removesuffix(SUFFIX) == path or path.removesuffix(SUFFIX) not in found
        }

    def stored_ids(self) -> set[str]:
        """The ids that files of the store belong to, which do not change while an earlier capture is ingested."""
        return {name.split("/")[1] for name in self.stored()}

    def used(self) -> dict[str, int]:
        """How much of each limit is used, of those that count."""
        limits = self.http.get("/v1/limits").json()["limits"]
        return {one["name"]: one["used"] for one in limits if one["used"] is not None}


def log_of(data: Path) -> Path:
    """The file with the log of the services that have served a folder."""
    return data.parent / f"{data.name}.log"


@contextmanager
def serving(
    data: Path, *options: str, within: Sequence[str] = (sys.executable,), **environment: str
) -> Iterator[Service]:
    """Serve a folder on a free port until the block ends; ``within`` runs Python with the arguments that follow."""
    command = [*within, "-m", "services", "serve", "--data", str(data), "--port", "0", *options]
    data.parent.mkdir(parents=True, exist_ok=True)
    with log_of(data).open("ab") as log:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
            env=os.environ | environment,
        )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert " at http" in line, log_of(data).read_text()
        url = line.rsplit(" at ", 1)[1].strip()
        key = environment.get("ENVMATTE_KEYS", "").partition(",")[0] or None
        with Client(url, key) as client, httpx2.Client(base_url=url, timeout=120) as http:
            yield Service(process, data, url, client, http)
    finally:
        process.terminate()
        process.wait(120)
        process.stdout.close()


@contextmanager
def paused(service: Service) -> Iterator[None]:
    """Suspend the workers of a service: uploads stay in the store.

    The scheduler replaces a worker that is silent for half a minute; the new one is suspended too.
    """

    def hold() -> None:
        for worker in workers(service.process):
            with suppress(psutil.NoSuchProcess):
                worker.suspend()

    until(lambda: workers(service.process))  # one that was idle or killed may just be replaced
    hold()
    try:
        with repeating(hold, 0.1):
            yield
    finally:
        for worker in workers(service.process):
            with suppress(psutil.NoSuchProcess):
                worker.resume()


def png(light: np.ndarray, transfer: str, dtype: type) -> bytes:
    """A backdrop of linear light, encoded as PNG."""
    return integer_formats.encode_png(
        integer_formats.to_integers(from_light(light, transfer), np.dtype(dtype))
    )


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder by relative name, except the live data made for browsers."""
    names = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in names.items()
        if not name.startswith("live-")
    }


@pytest.fixture(scope="session")
def program() -> Program:
    return nested_program(bands=BANDS, levels=5)


@pytest.fixture(scope="session")
def scene() -> Scene:
    return glass_ball.glass_ball(WIDTH, HEIGHT, rays=16)


@pytest.fixture(scope="session")
def capture_archive(scene: Scene, program: Program, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of the scene."""
    path = tmp_path_factory.mktemp("capture") / "ball.zip"
    write_capture(scene, program, path, name="ball")
    return path


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that tests share: each adds to it, none depends on what others did."""
    with serving(tmp_path_factory.mktemp("service") / "data") as running:
        yield running


@pytest.fixture(scope="session")
def capture(service: Service, capture_archive: Path) -> str:
    """The scene's capture, ingested."""
    uploaded = service.client.upload(capture_archive)
    service.client.wait(uploaded["job"])
    return str(uploaded["id"])


@pytest.fixture(scope="session")
def matte(service: Service, capture: str) -> str:
    """The scene's matte, recovered."""
    return str(service.client.wait(service.client.recover(capture)["id"])["matte"])
