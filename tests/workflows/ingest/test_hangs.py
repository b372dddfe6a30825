"""A decoder that hangs ends its process, and nothing else does."""

import subprocess
import sys
import time

import pytest

from workflows.ingest import hangs

SCRIPT = """
import time
from workflows.ingest import hangs
from workflows.ingest.video import Clip

class Film:
    def read(self, size):
        {}

    def seek(self, offset, whence=0):
        return 0

hangs.SECONDS = 1
Clip(Film(), "film.mp4", 1 << 20)
"""


@pytest.mark.parametrize(
    "hang", ["time.sleep(1000)", "sum(range(1 << 60))"], ids=["waits", "holds the interpreter"]
)
def test_a_decoder_that_hangs_ends_its_process_and_says_where(hang: str) -> None:
    ran = subprocess.run([sys.executable, "-c", SCRIPT.format(hang)], stderr=subprocess.PIPE, text=True)
    assert ran.returncode == 1
    assert "Timeout (0:00:01)!" in ran.stderr
    assert "in read" in ran.stderr


def test_what_ends_in_time_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hangs, "SECONDS", 0.2)
    for _ in range(3):
        with hangs.ended():
            pass
    with pytest.raises(ValueError, match="of its own"), hangs.ended():
        raise ValueError("of its own")
    time.sleep(0.5)
