"""The cost of progress: finished tiles are written many at once."""

import pytest

from services.coordinator.coordinator import WRITE
from tests.benchmarks.cluster.overhead import measure

OTHERS = 15
"""Writes once per job, or every few seconds in any case: start, stages, lease."""


@pytest.mark.exhaustive
def test_progress_takes_a_few_writes_a_second() -> None:
    row = measure(tiles=1500, seconds=0.0, workers=1, threads=4)
    writes = row["writes a second"] * row["seconds"]
    assert 2 < writes <= row["seconds"] * (1 / WRITE + 0.5) + OTHERS
    assert row["tiles"] > 5 * writes
