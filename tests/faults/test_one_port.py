"""Two services behind one port serve each other's uploads, jobs and mattes."""

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from services.client import Client
from tests.end_to_end.conftest import png
from tests.end_to_end.lines import Line
from tests.faults.conftest import Prepared

pytestmark = pytest.mark.timeout(900)


class InTurn(Line):
    """A proxy that alternates between two services and cuts some of its connections."""

    def __init__(self, targets: list[str], **cuts: int) -> None:
        self._targets = cycle(targets)
        super().__init__(targets[0], **cuts)

    @property
    def target(self) -> str:
        return next(self._targets)

    @target.setter
    def target(self, target: str) -> None:
        pass


@pytest.mark.exhaustive
def test_two_services_behind_one_port(prepared: Prepared, capture_archive: Path) -> None:
    rig = prepared.rig
    size = capture_archive.stat().st_size
    with InTurn(rig.urls, cuts=7, mean=size // 4, seed=3) as line, Client(line.url) as client:
        uploaded = client.upload(capture_archive)
        assert line.made == 7
        client.wait(uploaded["job"])
        job = client.wait(client.recover(uploaded["id"])["id"])
    assert rig.files(job["matte"]) == prepared.files
    seen = [rig.ask("GET", f"/v1/jobs/{job['id']}", at=url).json() for url in rig.urls]
    assert seen[0] == seen[1] == job.answer
    backdrop = png(np.full((2, 2, 3), 0.5, np.float32), "srgb", np.uint8)
    path = f"/v1/mattes/{job['matte']}/composite"
    answers = [rig.ask("POST", path, at=url, content=backdrop) for url in rig.urls]
    assert answers[0].status_code == 200
    assert answers[0].content == answers[1].content
