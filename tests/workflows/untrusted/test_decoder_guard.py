"""Decoders are bounded: one that hangs ends its process, one that takes too much memory is refused it."""

import mmap
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from fractions import Fraction
from io import BytesIO

import av
import numpy as np
import pytest

from storage.errors import CaptureError, ImageError
from tests.workflows.composite.video.test_steps import clip, even, pictures
from tests.workflows.ingest.video.camera import overstated
from workflows.untrusted import decoder_guard
from workflows.untrusted.decoder_guard import Guard

SCRIPT = """
import time
from workflows.untrusted import decoder_guard
from workflows.ingest.video.decoder import Clip

class Film:
    def read(self, size):
        {}

    def seek(self, offset, whence=0):
        return 0

decoder_guard.SECONDS = 1
Clip(Film(), "film.mp4", 1 << 20)
"""


@pytest.mark.parametrize(
    "hang", ["time.sleep(1000)", "sum(range(1 << 60))"], ids=["waits", "holds the interpreter"]
)
def test_hanging_decoder_ends_its_process_and_logs_where(hang: str) -> None:
    ran = subprocess.run([sys.executable, "-c", SCRIPT.format(hang)], stderr=subprocess.PIPE, text=True)
    assert ran.returncode == 1
    assert "Timeout (0:00:01)!" in ran.stderr
    assert "in read" in ran.stderr


def test_decoder_that_ends_in_time_continues(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoder_guard, "SECONDS", 0.2)
    for _ in range(3):
        with Guard("film.mp4", 1 << 20).on():
            pass
    with pytest.raises(ValueError, match="of its own"), Guard("film.mp4", 1 << 20).on():
        raise ValueError("of its own")
    time.sleep(0.5)


MIB = 1 << 20
MUCH = 1 << 30
"""More than the process has freed, and would find again without asking the system."""
linux = pytest.mark.skipif(sys.platform != "linux", reason="it is Linux that limits what a process takes")


def taken(size: int) -> mmap.mmap:
    """Memory that comes from the system, and goes back to it."""
    return mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[Guard]:
    """A guard that lets a decoder have 64 MB."""
    monkeypatch.setattr(decoder_guard, "EXTRA", 56 * MIB)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    yield Guard("film.mp4", MIB)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


@linux
def test_a_decoder_is_refused_more_memory_than_it_may_take(small: Guard) -> None:
    with small.on():
        bytearray(40 * MIB)
    with (
        pytest.raises(CaptureError, match=r"decoding film\.mp4 takes more than the 64 MB") as caught,
        small.on(),
    ):
        bytearray(MUCH)
    assert caught.value.fields == {"entry": "film.mp4", "limit": 64 * MIB}
    np.empty(MUCH, np.uint8)


@linux
def test_unspecific_error_for_lack_of_memory_is_recognised(small: Guard) -> None:
    def decode() -> None:
        try:
            bytearray(MUCH)
        except MemoryError as error:
            raise ImageError("the image is cut off or damaged") from error

    with pytest.raises(CaptureError, match="more than the 64 MB"), small.on():
        decode()
    with pytest.raises(ImageError, match="as it is"), small.on():
        raise ImageError("as it is")


@linux
def test_only_memory_of_guarded_decoders_is_added_up(small: Guard) -> None:
    kept = []
    for _ in range(3):
        with small.on():
            pass
        kept.append(taken(50 * MIB))
    with small.on():
        kept.append(taken(40 * MIB))
    with pytest.raises(OSError, match="Cannot allocate"), small.on():
        taken(40 * MIB)
    kept.pop().close()  # given back outside
    for _ in range(9):
        with small.on():
            frame = taken(40 * MIB)
        frame.close()


@linux
def test_lower_limit_of_the_process_is_kept(small: Guard) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    lower = decoder_guard.in_use() + 20 * MIB
    resource.setrlimit(resource.RLIMIT_DATA, (lower, hard))
    try:
        with pytest.raises(CaptureError), small.on():
            bytearray(MUCH)
        assert resource.getrlimit(resource.RLIMIT_DATA) == (lower, hard)
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


COUNTS_SAMPLES = av.library_versions["libavformat"] >= (63,)
"""Whether FFmpeg knows by itself how many samples can be in a fragment at most."""

PEAK = """
import io, re, sys
from pathlib import Path
from storage.errors import CaptureError
from workflows.ingest.video.decoder import Clip

def peak():
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) >> 10

film = io.BytesIO(sys.stdin.buffer.read())
before = peak()
try:
    Clip(film, "film.mp4", 1 << 20).ticks(1000)
except CaptureError as error:
    assert error.fields["entry"] == "film.mp4"
    print(peak() - before, error.detail)
"""


def fragmented(samples: int) -> bytes:
    """An MP4 of ten fragments, of which all but the first say that they have many samples (sect. 8.8.8)."""
    target = BytesIO()
    flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}
    with av.open(target, "w", format="mp4", options=flags) as box:
        stream = box.add_stream("mjpeg", rate=Fraction(10))
        stream.width = stream.height = 64
        stream.pix_fmt = "yuvj420p"
        for n in range(10):
            box.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 * n, np.uint8))))
        box.mux(stream.encode())
    made = bytearray(target.getvalue())
    at = made.index(b"trun") + 4
    while (at := made.find(b"trun", at) + 4) > 4:
        made[at : at + 8] = (1).to_bytes(4, "big") + samples.to_bytes(4, "big")
    return bytes(made)


@linux
@pytest.mark.parametrize(
    ("film", "reason"),
    [
        (overstated(clip(pictures(9), even(9)), 40_000_000), "an index that takes too much memory"),
        (fragmented(4_000_000), "Invalid data found" if COUNTS_SAMPLES else "takes more than the 264 MB"),
    ],
    ids=["at once", "bit by bit"],
)
def test_film_of_a_few_kilobytes_does_not_take_gigabytes(film: bytes, reason: str) -> None:
    assert len(film) < 20_000
    ran = subprocess.run([sys.executable, "-c", PEAK], input=film, stdout=subprocess.PIPE, check=True)
    grown, _, detail = ran.stdout.decode().partition(" ")
    assert int(grown) < 300
    assert reason in detail
