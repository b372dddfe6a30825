"""Decoders are confined, bounded, and not believed: by functions that behave as if a file had taken one over."""

import io
import os
import pickle
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from storage.errors import CaptureError, ImageError, Unavailable
from tests.parts.processes import alive
from tests.parts.waiting import until
from tests.workflows.untrusted import taken_over
from workflows.untrusted import confinement, decoder, decoder_server
from workflows.untrusted.decoder import Decoder, DecoderEnded, blaming
from workflows.untrusted.decoder_server import Server

IMAGE = 1 << 20
confined = pytest.mark.skipif(confinement.missing() is not None, reason=str(confinement.missing()))


@pytest.fixture(scope="module", autouse=True)
def server() -> Iterator[Server]:
    """A server of which decoders can run the functions of `taken_over`, started with a secret in the environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ENVMATTE_KEYS", "a-secret-key")
        patch.syspath_prepend(Path(__file__).parents[3])  # the server finds its modules as this process does
        patch.setattr(decoder_server, "MODULES", [*decoder_server.MODULES, taken_over.__name__])
        server = Server()
        patch.setattr(decoder, "server", server)
        yield server
        server.stop()


def process_of(server: Server) -> psutil.Process:
    assert server._process is not None
    return psutil.Process(server._process.pid)


@confined
def test_decoder_that_was_taken_over_can_do_nothing(server: Server, tmp_path: Path) -> None:
    database = tmp_path / "envmatte.db"
    database.write_bytes(b"rows")
    with Decoder(IMAGE) as found:
        (report,) = found.run(taken_over.attack, b"", victim=os.getpid(), secret=str(database))
        (child,) = process_of(server).children()
        # What others can see of it, too: the file shows what a process was started with.
        for process in (child, process_of(server)):
            assert b"secret" not in Path(f"/proc/{process.pid}/environ").read_bytes()
            assert not any("secret" in word for word in process.cmdline())
    assert report["done"] == []
    assert report["environment"] == []
    assert report["others"] == []
    assert report["devices"] == 1  # standard input, output and error lead to /dev/null
    assert {path.name for path in tmp_path.iterdir()} == {database.name}
    assert database.read_bytes() == b"rows"


def test_attacks_succeed_where_nothing_confines(tmp_path: Path) -> None:
    """Otherwise the test above would show nothing."""
    database = tmp_path / "envmatte.db"
    database.write_bytes(b"rows")
    harmless = {
        "environment of the service",
        "read the database",
        "write the database",
        "a link to it",
        "kill",
    }
    for name, attack in taken_over.attacks(os.getpid(), str(database)).items():
        if name in harmless:
            attack()


def test_file_is_read_piece_by_piece_as_it_is_needed() -> None:
    data = np.random.default_rng(0).integers(0, 256, 1_000_000, np.uint8).tobytes()
    with Decoder(IMAGE) as found:
        for file in (data, io.BytesIO(data)):
            fields, pixels = found.run(taken_over.read_back, file)
            assert {"SIGINT", "SIGTERM"} <= set(fields["ignored"])  # they are for the service
            end, pieces = len(data), b""
            for size in (1, 70_000, 3, 300_001):
                end -= size
                pieces += data[end : end + size]
            assert pixels.tobytes() == pieces


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="it is Linux that limits what a process takes")
def test_file_that_is_sent_whole_is_in_memory_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoder, "COPIES", 0)
    monkeypatch.setattr(decoder, "EXTRA", 180 << 20)
    with Decoder(IMAGE) as found:
        answers = found.run(taken_over.measure, io.BytesIO(bytes(120 << 20)), whole=True)
        assert list(answers) == [{"size": 120 << 20}]


def framed(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def array(shape: str, dtype: str = "uint8") -> bytes:
    return framed(b'{"shape": %s, "dtype": "%s"}' % (shape.encode(), dtype.encode()))


BAD_ANSWERS = {
    "pickle": pickle.dumps(print),
    "framed pickle": framed(pickle.dumps({"done": True})),
    "nothing known": framed(b"{}"),
    "long head": struct.pack("<I", 1 << 31),
    "deep": framed(b"[" * 60_000),
    "large": array("[100000, 40, 3]", "float32"),
    "overflowing": array("[4294967296, 4294967296, 4294967296, 0]"),
    "negative": array("[-1, 40, 3]"),
    "fraction": array("[30.5, 40, 3]"),
    "infinite": array("[1e999, 40, 3]"),
    "objects": array("[30, 40, 3]", "object"),
    "too few": array("[30, 40, 3]") + b"too few",
    "four floats": array("[1, 1, 4]", "float32") + bytes(16) + framed(b'{"done": true}'),
    "no picture": array("[4]") + bytes(4) + framed(b'{"done": true}'),
    "two pictures": 2 * (array("[1, 1, 1]") + b"0"),
    "fields": framed(b'{"value": {"height": 30}}') + framed(b'{"done": true}'),
    "foreign bytes": framed(b'{"read": 0, "count": 1}'),
    "alive for ever": framed(b'{"alive": true}'),
    "wrong refusal": framed(b'{"refused": 3, "limit": null}'),
    "more": framed(b'{"refused": "no", "limit": null, "status": 200}'),
    "end": b"",
}


@pytest.mark.parametrize("name", BAD_ANSWERS)
def test_invalid_answer_is_refused(name: str) -> None:
    with Decoder(IMAGE) as found, pytest.raises(DecoderEnded):
        found.picture(taken_over.send, BAD_ANSWERS[name])
    assert found.has_ended


@pytest.mark.parametrize(
    "asked", [b'{"read": 7, "count": 2}', b'{"read": -1, "count": 1}', b'{"read": 0, "count": 0}']
)
def test_only_bytes_of_the_file_are_given(asked: bytes) -> None:
    with Decoder(IMAGE) as found, pytest.raises(DecoderEnded):
        list(found.run(taken_over.send, io.BytesIO(framed(asked)[:8])))


def test_crash_is_reported_as_a_reason_to_try_again() -> None:
    ended = pytest.raises(Unavailable, match=r"film\.mp4 ended .* \(SIGSEGV\)")
    with Decoder(IMAGE) as found, ended, blaming("film.mp4", found):
        list(found.run(taken_over.crash, b""))


def test_words_of_a_library_stay_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with Decoder(IMAGE) as found, pytest.raises(ImageError, match="save it again") as refused:
        list(found.run(taken_over.stumble, b""))
    assert "libglass" not in refused.value.detail
    assert "libglass: bad huffman code" in caplog.text


def test_decoder_that_hangs_is_ended() -> None:
    with (
        Decoder(IMAGE, seconds=0.5) as found,
        pytest.raises(Unavailable, match="hang"),
        blaming("film.mp4", found),
    ):
        list(found.run(taken_over.hang, io.BytesIO(struct.pack("<d", 60))))
    assert found.has_ended


@pytest.mark.slow
def test_decoder_that_shows_life_may_take_longer() -> None:
    with Decoder(IMAGE, seconds=8) as found:  # a busy machine may take some of them to start it
        assert list(found.run(taken_over.hang, io.BytesIO(struct.pack("<d", 10)))) == [{"alive": True}]


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="it is Linux that limits what a process takes")
def test_decoder_that_takes_too_much_memory_is_refused_it_and_goes_on() -> None:
    room = decoder.room(IMAGE)
    with Decoder(IMAGE) as found:
        refused = pytest.raises(CaptureError, match=r"film\.mp4 takes more than the 264 MB")
        with refused as caught, blaming("film.mp4", found):
            list(found.run(taken_over.hoard, b"", size=2 * room))
        assert caught.value.fields == {"entry": "film.mp4", "limit": room}
        assert len(list(found.run(taken_over.hoard, b"", size=room // 2))) == 1


def test_server_that_died_is_replaced(server: Server) -> None:
    with Decoder(IMAGE) as found:
        list(found.run(taken_over.hoard, b"", size=1))
        (child,) = process_of(server).children()
        process_of(server).kill()
        until(lambda: not alive([child]))
        with pytest.raises(DecoderEnded, match="forked from"):
            list(found.run(taken_over.hoard, b"", size=1))
    with Decoder(IMAGE) as found:
        assert len(list(found.run(taken_over.hoard, b"", size=1))) == 1
