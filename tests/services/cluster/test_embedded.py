"""The embedded cluster: where it listens, and how many workers it has."""

import time
from pathlib import Path

import psutil
import pytest

from services.cluster.connect import connect
from services.cluster.embedded import Scale, embedded
from services.settings import Settings
from tests.services.cluster.clusters import listening


def test_workers_scale_with_tiles_and_stop_when_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    targets: list[int] = []
    scale = Scale(targets.append, 4)
    scale(0)
    now = 400.0
    scale(0)
    scale(0)
    assert targets == [1]
    scale(3)
    scale(2)
    scale(100)
    assert targets == [1, 3, 4]
    now = 600.0
    scale(0)
    assert targets == [1, 3, 4]
    now = 701.0
    scale(0)
    assert targets == [1, 3, 4, 1]


def test_the_embedded_cluster_listens_on_loopback_only(tmp_path: Path) -> None:
    this = psutil.Process()
    others = set(this.children(recursive=True))
    with embedded(Settings(data=tmp_path, workers=1)) as cluster:
        found = {ip for one in {this, *this.children(recursive=True)} - others for ip, _ in listening(one)}
        assert found == {"127.0.0.1"}
        with connect(cluster.scheduler_address, None) as client:
            assert list(client.nthreads().values()) == [1]
