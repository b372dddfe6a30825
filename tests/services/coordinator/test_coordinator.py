"""What progress costs: a job's tiles are written down many at once, however fast they are done."""

import pytest

from services.coordinator.coordinator import WRITE
from tests.benchmarks.cluster.overhead import measure

OTHERS = 15
"""Writes that come once a job, or every few seconds whatever goes on: its start, its stages, the lease."""


@pytest.mark.exhaustive
def test_progress_takes_a_few_writes_a_second() -> None:
    row = measure(tiles=1500, seconds=0.0, workers=1, threads=4)
    writes = row["writes a second"] * row["seconds"]
    assert 2 < writes <= row["seconds"] * (1 / WRITE + 0.5) + OTHERS
    assert row["tiles"] > 5 * writes
