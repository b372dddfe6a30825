"""What is deleted while others read it is gone for them: never an error of the service."""

import shutil
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
import pytest
from sqlalchemy import Engine, select

from storage.database.engine import open_engine, reading, writing
from storage.database.owners import DEFAULT, for_owner
from storage.database.rows import new_id
from storage.database.tables import captures as capture_table
from storage.layout import captures as stored_captures
from storage.layout import composites
from storage.layout.captures import create_stack, write_slab
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from tests.end_to_end.conftest import Service
from tests.parts.inputs.hostile_mattes import large_matte
from tests.parts.waiting import until

READERS = 6
EDGE = 512
"""Of a matte's frame: its layers take some tenths of a second, so some are under way when it is deleted."""
FRAME = 3000
"""Of a capture's."""


@dataclass
class Made:
    """A place to make things in that a service then has, without asking it."""

    store: Path
    engine: Engine
    capture: str
    """A capture that the service has ingested, to copy."""

    def matte(self, id: str) -> None:
        made = large_matte(self.store, id, EDGE)
        with writing(self.engine) as c:
            mattes.add_imported(c, id, {"method": "lobes"}, made.figures)

    def frames(self, id: str) -> None:
        objects, shape = Objects(self.store.as_uri()), (1, FRAME, FRAME, 1)
        options = {"memory": 512 << 20, "attributes": {}, "mask": None, "images": []}
        create_stack(objects, id, shape, np.dtype(np.uint8), **options)
        write_slab(objects, id, 0, np.random.default_rng(0).integers(0, 256, shape, np.uint8))
        self._capture(id, width=FRAME, height=FRAME, frames=1)

    def copy(self, id: str) -> None:
        shutil.copytree(
            self.store / stored_captures.path(self.capture), self.store / stored_captures.path(id)
        )
        with reading(self.engine) as c:
            row = c.execute(select(capture_table).where(capture_table.c.id == self.capture)).one()
        self._capture(id, width=row.width, height=row.height, frames=row.frames)

    def _capture(self, id: str, *, frames: int, **size: int) -> None:
        with writing(self.engine) as c:
            captures.add(c, id, "0" * 20, name="", bytes=1, frames=frames, program={})
            captures.change(c, id, state="ready", **size)

    def video(self, id: str) -> None:
        file = self.store / composites.video_path(id)
        file.parent.mkdir(parents=True)
        file.write_bytes(bytes(1 << 20))
        with writing(self.engine) as c:
            jobs.add(c, "composite", "", {}, job=id)
            jobs.change(c, id, state="succeeded")


@pytest.fixture(scope="module")
def made(service: Service, capture: str) -> Iterator[Made]:
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    yield Made(service.data / "store", for_owner(engine, DEFAULT), capture)
    engine.dispose()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "path"),
    [
        pytest.param("matte", "/v1/mattes/{id}/layers/S.exr", marks=pytest.mark.exhaustive),
        pytest.param("matte", "/v1/mattes/{id}/layers/rho.png", marks=pytest.mark.exhaustive),
        ("matte", "/v1/mattes/{id}/layers/all.exr"),
        ("matte", "/v1/mattes/{id}/live"),
        pytest.param("matte", "/v1/mattes/{id}/transport?x=300&y=300", marks=pytest.mark.exhaustive),
        pytest.param("matte", "/v1/mattes/{id}/transport.png?x=300&y=300", marks=pytest.mark.exhaustive),
        ("matte", "/v1/mattes/{id}/archive"),
        ("frames", "/v1/captures/{id}/frames/0.png"),
        pytest.param("copy", "/v1/captures/{id}/contact-sheet.png", marks=pytest.mark.exhaustive),
        ("copy", "/v1/captures/{id}/report"),
        ("video", "/v1/jobs/{id}/video.mp4"),
    ],
)
def test_what_is_deleted_under_its_readers_is_not_found(
    service: Service, made: Made, what: str, path: str, times: int
) -> None:
    make: Callable[[str], None] = getattr(made, what)
    answers: Counter[object] = Counter()
    for _ in range(times):
        id = new_id()
        make(id)
        address = path.format(id=id)
        deleted = address.partition(id)[0] + id
        begun: list[int] = []

        def read(address: str = address, begun: list[int] = begun) -> None:
            with httpx2.Client(base_url=service.url, timeout=120) as http:
                while True:
                    begun.append(1)
                    try:
                        answer = http.get(address)
                    except httpx2.RemoteProtocolError:  # an answer that had begun can only end early
                        answers["cut off"] += 1
                        continue
                    answers[answer.status_code] += 1
                    if answer.status_code != 200:
                        return

        readers = [threading.Thread(target=read) for _ in range(READERS)]
        for reader in readers:
            reader.start()
        until(lambda begun=begun: len(begun) > READERS)
        assert service.http.delete(deleted).status_code == 204
        for reader in readers:
            reader.join()
    print(f"\n{path}: {dict(answers)}")
    assert answers.keys() <= {200, 404, "cut off"}
    assert answers[404] == times * READERS
