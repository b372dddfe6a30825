"""A store that fails: full disks, and buckets that do not answer."""

import errno
import os
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import zarr
from obstore.exceptions import GenericError

from storage.errors import NoRoom, StoreUnavailable, Unavailable
from storage.objects import store as module
from storage.objects.byte_objects import PART
from storage.objects.event_loop import gather
from storage.objects.retries import translate_errors
from storage.objects.store import Objects
from tests.parts.waiting import until
from tests.storage.conftest import DISK
from tests.storage.installation import stream

ANSWER = b"<Error><Message>slow - down</Message><AWSAccessKeyId>somebody</AWSAccessKeyId></Error>"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gives up on a bucket immediately instead of after a minute."""
    backoff = {
        "init_backoff": timedelta(milliseconds=1),
        "max_backoff": timedelta(milliseconds=10),
        "base": 2,
    }
    monkeypatch.setattr(module, "RETRIES", module.RETRIES | {"max_retries": 1, "backoff": backoff})
    monkeypatch.setattr(module, "REQUESTS", module.REQUESTS | {"timeout": timedelta(seconds=1)})


@contextmanager
def _answering(status: int, body: bytes) -> Iterator[str]:
    """The URL of a server that answers everything with an error."""

    class Refusing(BaseHTTPRequestHandler):
        def _refuse(self) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _refuse

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


@pytest.fixture(params=["refused", "silent", "503", "429"])
def unreachable(
    impatient: None, request: pytest.FixtureRequest, s3: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """The URL of a store whose bucket does not answer, or answers with an error."""

    if request.param in ("503", "429"):
        with _answering(int(request.param), ANSWER) as url:
            monkeypatch.setenv("AWS_ENDPOINT_URL", url)
            yield s3
        return
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        if request.param == "silent":
            taken.listen(100)
            short = module.REQUESTS | {"timeout": timedelta(seconds=0.2)}
            monkeypatch.setattr(module, "REQUESTS", short)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{taken.getsockname()[1]}")
        yield s3


def test_every_call_reports_unreachable_bucket(unreachable: str) -> None:
    objects = Objects(unreachable)
    array = np.zeros(3)
    requests: list[Callable[[], object]] = [
        objects.check_reachable,
        lambda: objects.read("a"),
        lambda: objects.put("a", b"1"),
        lambda: stream(objects, "a", b"1"),
        lambda: stream(objects, "a", bytes(PART + 1)),
        lambda: objects.names("a"),
        lambda: objects.paths_below("a"),
        lambda: objects.written_at("a"),
        lambda: objects.delete("a"),
        lambda: gather(objects.group("a")),
        lambda: gather(objects.array("a")),
        lambda: gather(objects.put_array("a", array)),
        lambda: zarr.create_array(objects.zarr, name="a", data=array),
        lambda: zarr.open_group(objects.zarr, path="a"),
    ]

    def attempt(request: Callable[[], object]) -> None:
        with pytest.raises(Unavailable, match=r"try again later \((HTTP error: [a-z ]+|status code: \d+)\)"):
            request()

    with ThreadPoolExecutor(len(requests)) as threads:  # one after another they would wait for seconds
        list(threads.map(attempt, requests))


def test_bucket_that_disconnects_during_read(impatient: None, s3: str) -> None:
    there = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://").split(":")
    with socket.create_server(("127.0.0.1", 0)) as between:
        os.environ["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{between.getsockname()[1]}"
        sockets: list[socket.socket] = []

        def relay() -> None:
            while True:
                try:
                    near, _ = between.accept()
                except OSError:
                    return
                far = socket.create_connection((there[0], int(there[1])))
                sockets.extend((near, far))
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=carry, args=(one, other)).start()

        def carry(one: socket.socket, other: socket.socket) -> None:
            try:
                while data := one.recv(1 << 16):
                    other.sendall(data)
            except OSError:
                pass

        thread = threading.Thread(target=relay)
        thread.start()
        objects = Objects(s3)
        data = np.random.default_rng(0).bytes(3 << 20)
        stream(objects, "a", data)
        with objects.read("a") as file:
            assert file.read(1000) == data[:1000]
            between.shutdown(socket.SHUT_RDWR)
            thread.join()
            for one in sockets:
                one.close()
            with pytest.raises(Unavailable):
                file.read()


def test_service_that_does_not_answer_is_unavailable(impatient: None) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(Unavailable, match="cannot be reached"):
            Objects(f"http://127.0.0.1:{taken.getsockname()[1]}/v1").get(["mattes/m/zarr/zarr.json"])


def test_missing_bucket_is_named_by_every_call_that_writes_or_lists(s3: str) -> None:
    objects = Objects(s3.replace("envmatte", "another"))
    requests: list[Callable[[], object]] = [
        objects.check_reachable,
        objects.clock,
        lambda: objects.put("a", b"1"),
        lambda: stream(objects, "a", b"1"),
        lambda: stream(objects, "a", bytes(PART + 1)),
        lambda: objects.written_at("a"),
        lambda: gather(objects.put_array("a", np.zeros(3))),
    ]
    for request in requests:
        with pytest.raises(
            StoreUnavailable, match="the store refuses: NoSuchBucket; check its bucket's name"
        ):
            request()


@pytest.mark.parametrize(
    ("status", "code"),
    [(403, "InvalidAccessKeyId"), (403, "SignatureDoesNotMatch"), (401, "Unknown"), (400, "ExpiredToken")],
)
def test_refused_keys_are_named_without_retrying(
    status: int, code: str, s3: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with _answering(status, f"<Error><Code>{code}</Code></Error>".encode()) as url:
        monkeypatch.setenv("AWS_ENDPOINT_URL", url)
        objects = Objects(s3)
        for request in (objects.check_reachable, objects.clock, lambda: objects.read_raw("a")):
            with pytest.raises(StoreUnavailable, match=f"the store refuses: ({code}|401 Unauthorized);"):
                request()


def test_missing_object_of_a_bucket_is_no_refusal(s3: str) -> None:
    with pytest.raises(FileNotFoundError):
        Objects(s3).read_raw("a")
    with pytest.raises(FileNotFoundError):
        Objects(s3).read("a")


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOSPC, NoRoom),
        (errno.EDQUOT, NoRoom),
        (errno.EROFS, StoreUnavailable),
        (errno.EACCES, StoreUnavailable),
        (errno.EPERM, StoreUnavailable),
        (errno.ENOENT, FileNotFoundError),
    ],
)
def test_errors_of_a_disk_are_distinguished_by_their_number(number: int, kind: type[Exception]) -> None:
    """As obstore words them: a quota and a disk that may only be read can't be set up here."""
    with pytest.raises(kind), translate_errors():
        raise GenericError(f"Generic LocalFileSystem error: {os.strerror(number)} (os error {number})")


@pytest.mark.parametrize("piece", [1 << 18, 9 << 20, 2 * DISK], ids=["crumbs", "parts", "at once"])
def test_writer_leaves_nothing_on_full_disk(disk: Path, piece: int) -> None:
    objects = Objects((disk / "store").as_uri())
    stream(objects, "a", os.urandom(1000))
    with pytest.raises(NoRoom, match="free space"):
        stream(objects, "b", os.urandom(2 * DISK), piece)
    assert {path.name for path in disk.rglob("*") if path.is_file()} == {"a", "a.crc32c"}
    # A part under way holds what was removed.
    until(lambda: shutil.disk_usage(disk).free > DISK // 2 + (1 << 20))
    stream(objects, "b", os.urandom(DISK // 2), piece)
    assert objects.names("") == ["a", "b"]


def test_small_object_on_full_disk(disk: Path) -> None:
    objects = Objects((disk / "store").as_uri())
    with pytest.raises(NoRoom, match="free space"):
        objects.put("a", bytes(DISK + 1))

    def is_written() -> bool:
        try:
            objects.put("a", b"1")
        except NoRoom:
            return False
        return True

    until(is_written)  # on a busy machine what failed may take its room for a moment longer
    assert objects.read("a").read() == b"1"


def test_chunk_on_full_disk(disk: Path) -> None:
    objects = Objects((disk / "store").as_uri())
    array = zarr.create_array(
        objects.zarr,
        name="a",
        shape=(2, DISK * 2 // 3),
        chunks=(1, DISK * 2 // 3),
        dtype="u1",
        compressors=None,
    )
    array[0, :] = 1
    with pytest.raises(NoRoom, match="free space"):
        array[1, :] = 1
    assert np.asarray(array[0, :10]).all()
