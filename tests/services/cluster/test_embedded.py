"""The number of workers of the embedded cluster."""

import time

import pytest

from services.cluster.embedded import Scale


def test_a_cluster_has_as_many_workers_as_are_of_use(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    asked: list[int] = []
    scale = Scale(asked.append, 4)
    scale(0)
    now = 400.0
    scale(0)
    scale(0)
    assert asked == [1]
    scale(3)
    scale(2)
    scale(100)
    assert asked == [1, 3, 4]
    now = 600.0
    scale(0)
    assert asked == [1, 3, 4]
    now = 701.0
    scale(0)
    assert asked == [1, 3, 4, 1]
