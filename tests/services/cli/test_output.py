"""Files that commands write with -o."""

import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from services.client import Client, Unreachable
from services.runtime.whole_files import open_whole
from tests.services.client.servers import ok, scripted_server, web_server

ARCHIVE = 200, {}, b"an archive" * 1000
CUT_OFF = 200, {"Content-Length": "20000"}, b"an archive" * 1000


@contextmanager
def read_from(pipe: Path) -> Iterator[list[bytes]]:
    """Read a named pipe until its writer has closed it; yields what will have been read when the block has ended."""
    os.mkfifo(pipe)
    found: list[bytes] = []
    reader = threading.Thread(target=lambda: found.append(pipe.read_bytes()), daemon=True)
    reader.start()
    yield found
    reader.join(60)


def export(output: Path, url: str) -> None:
    done = CliRunner().invoke(main, ["export", "m", "-o", str(output), "--url", url])
    assert (done.exit_code, done.stdout) == (0, f"{output}\n"), done.output


def test_a_pipe_is_written_to_and_stays(tmp_path: Path) -> None:
    with scripted_server(lambda n: ARCHIVE) as (url, _), read_from(tmp_path / "pipe") as found:
        export(tmp_path / "pipe", url)
    assert found == [ARCHIVE[2]]
    assert (tmp_path / "pipe").is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


def test_an_export_that_breaks_off_is_not_repeated_into_a_pipe(tmp_path: Path) -> None:
    with (
        scripted_server(lambda n: ok() if n == 0 else CUT_OFF) as (url, calls),
        Client(url) as client,
        read_from(tmp_path / "pipe") as found,
    ):
        client.job("j")  # a service that has answered once is retried
        with pytest.raises(Unreachable):
            client.export("m", tmp_path / "pipe")
    assert found == [CUT_OFF[2]]
    assert len(calls) == 2


def test_an_export_that_breaks_off_is_repeated_into_a_file(tmp_path: Path) -> None:
    answers = (ok(), CUT_OFF, ARCHIVE)
    with scripted_server(lambda n: answers[n]) as (url, _), Client(url) as client:
        client.job("j")
        client.export("m", tmp_path / "matte.zip")
    assert (tmp_path / "matte.zip").read_bytes() == ARCHIVE[2]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "matte.zip", tmp_path / "link.zip"
    link.symlink_to(target)
    with scripted_server(lambda n: ARCHIVE) as (url, _):
        for _ in range(2):  # it leads nowhere at first
            export(link, url)
            assert link.is_symlink()
            assert target.read_bytes() == ARCHIVE[2]
            target.write_bytes(b"an older one")


def test_files_beside_the_output_stay(tmp_path: Path) -> None:
    (tmp_path / "matte.zip.part").write_bytes(b"not ours")
    with scripted_server(lambda n: ARCHIVE) as (url, _):
        export(tmp_path / "matte.zip", url)
    assert sorted(os.listdir(tmp_path)) == ["matte.zip", "matte.zip.part"]
    assert (tmp_path / "matte.zip.part").read_bytes() == b"not ours"


def test_two_writers_of_a_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "matte.zip"
    with open_whole(path) as one, open_whole(path) as other:
        one.write(b"one")
        other.write(b"other")
    assert path.read_bytes() == b"one"
    assert os.listdir(tmp_path) == ["matte.zip"]


@pytest.fixture
def hangups_end() -> Iterator[None]:
    """What is started ends at SIGHUP, although `nohup pytest` ignores it, and so would all that it starts."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_export_that_is_ended_leaves_nothing(tmp_path: Path, number: int, hangups_end: None) -> None:
    begun, ended = threading.Event(), threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "2000000")
            self.end_headers()
            self.wfile.write(bytes(1_000_000))
            begun.set()
            ended.wait(60)

        def log_message(self, *arguments: object) -> None:
            pass

    with web_server(Slow) as url:
        command = [sys.executable, "-m", "services", "export", "m", "-o", tmp_path / "m.zip", "--url", url]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as exporting:
            assert begun.wait(60)
            exporting.send_signal(number)
            _, said = exporting.communicate(timeout=60)
        ended.set()
    assert (exporting.returncode, said.splitlines()[-1]) == (130, "Interrupted.")
    assert not list(tmp_path.iterdir())


def test_a_file_has_the_mode_of_the_umask_and_a_failure_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "matte.zip"
    before = os.umask(0o027)
    try:
        with open_whole(path) as file:
            file.write(b"whole")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(TypeError), open_whole(path) as file:
        file.writelines([b"half", None])  # type: ignore[list-item]
    assert path.read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["matte.zip"]


def test_standard_output_has_the_file_and_nothing_else(tmp_path: Path) -> None:
    # A link of our own, so that a command that replaces its output leaves /dev/stdout alone.
    (tmp_path / "stdout").symlink_to("/dev/fd/1")
    command = [sys.executable, "-m", "services", "export", "m", "-o", str(tmp_path / "stdout")]
    with scripted_server(lambda n: ARCHIVE) as (url, _):
        done = subprocess.run([*command, "--url", url], capture_output=True, timeout=300, check=True)
    assert done.stdout == ARCHIVE[2]
    assert os.listdir(tmp_path) == ["stdout"]


def test_standard_output_that_is_a_file_keeps_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "stdout").symlink_to("/dev/fd/1")
    command = [sys.executable, "-m", "services", "export", "m", "-o", str(tmp_path / "stdout")]
    with scripted_server(lambda n: ARCHIVE) as (url, _), (tmp_path / "all").open("wb") as file:
        for text in (b"before ", b" after"):
            file.write(text)
            file.flush()
            if text == b"before ":
                subprocess.run([*command, "--url", url], stdout=file, timeout=300, check=True)
    assert (tmp_path / "all").read_bytes() == b"before " + ARCHIVE[2] + b" after"


def test_closed_standard_output_is_none_of_the_files(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code = f"from services.runtime.whole_files import *; print(is_standard_output(Path({str(tmp_path / 'file')!r})))"
    shell = 'exec 3>&1; "$0" -c "import sys; sys.stdout = open(3, \'w\'); $1" >&-'
    done = subprocess.run(
        ["sh", "-c", shell, sys.executable, code], capture_output=True, timeout=60, check=True
    )
    assert done.stdout == b"False\n"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes devices")
def test_an_export_into_a_device_is_written_to_it(tmp_path: Path) -> None:
    null = tmp_path / "null"
    os.mknod(null, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    with scripted_server(lambda n: ARCHIVE) as (url, _):
        export(null, url)
    assert null.is_char_device()
