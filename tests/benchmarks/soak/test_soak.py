"""A short day of the soak runs and leaves nothing."""

from pathlib import Path

import pytest

from tests.benchmarks.soak.soak import soak


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_short_day_leaves_nothing(tmp_path: Path) -> None:
    found = soak(12, 1.2, tmp_path)
    # A process that has just started still grows to its usual size.
    assert [one for one in found["problems"] if ": MB grows" not in one] == []
    assert len(found["samples"]) == 13
    assert len(found["done"]) > 20
