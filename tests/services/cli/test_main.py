"""The command line without a service: its help, completion and exit codes."""

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from services.api.mattes import layers
from services.cli import keys
from services.cli.main import main
from services.cli.remote import jobs, mattes
from services.cli.remote import mattes as remote_mattes
from services.client import Unreachable
from services.settings import (
    ClusterSettings,
    CoordinatorSettings,
    SchedulerSettings,
    Settings,
    describe_settings,
)
from storage.database import owners
from storage.records import api_keys
from tests.parts.processes import interrupt, running
from tests.services.client.servers import JOB, ok, refusal, scripted_server, web_server

ROOT = Path(__file__).parents[3]
README = (ROOT / "services/cli/README.md").read_text()
COMMAND = [sys.executable, "-m", "services"]
PROCESSES = {"serve", "coordinator", "scheduler", "worker", "completion"}
"""Commands that have no answer to print as JSON."""


def envmatte(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [*COMMAND, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ | environment)


def commands(group: click.Group = main, *above: str) -> Iterator[tuple[str, click.Command]]:
    """Every command and group by its whole name, as `keys make`."""
    for name, command in group.commands.items():
        yield " ".join([*above, name]), command
        if isinstance(command, click.Group):
            yield from commands(command, *above, name)


ALL = dict(commands())
HEAVY = {"alembic", "dask", "distributed", "numba", "numpy", "zarr"}
"""Libraries that take long to import, and that no quick command needs."""
UNREACHABLE = ["--url", "http://127.0.0.1:9"]
REMOTE = {
    "upload": ["film.zip"],
    "recover": ["c"],
    "status": ["j"],
    "wait": ["j"],
    "pause": ["j"],
    "resume": ["j"],
    "cancel": ["j"],
    "composite": ["m", "backdrop.png", "-o", "composite.png"],
    "export": ["m", "-o", "matte.zip"],
    "share": ["m"],
    "import": ["matte.zip"],
    "layers": ["m", "layers"],
    "list": ["mattes"],
    "delete": ["mattes", "m"],
}
"""Arguments of every command that does nothing but talk to a service."""


@pytest.mark.parametrize("name", ALL)
def test_help_of_every_command_has_a_valid_example(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = CliRunner().invoke(main, [*name.split(), "--help"]).output
    lines = re.search(r"Example:\n((?:    .*\n)+)", text)
    assert lines, text
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stills").mkdir()
    for file in ("film.zip", "matte.zip", "backdrop.png", "program.json", "patterns.json", "film.mkv"):
        (tmp_path / file).write_bytes(b"any")
    if name == "completion":
        assert 'eval "$(envmatte completion bash)"' in lines[1]
        return
    for line in lines[1].splitlines():
        depth = 1 + len(name.split())
        words = shlex.split(line)
        assert words[:depth] == ["envmatte", *name.split()]
        ALL[name].make_context(name, words[depth:])


@pytest.mark.parametrize("name", sorted(ALL.keys() - PROCESSES))
def test_every_command_that_prints_prints_json(name: str) -> None:
    leaf = not isinstance(ALL[name], click.Group)
    assert any("--json" in parameter.opts for parameter in ALL[name].params) == leaf


def test_help_names_the_file_beside_a_video_as_it_is_written() -> None:
    for name in ("patterns", "tether"):
        described = CliRunner().invoke(main, [name, "--help"]).stdout
        assert (".json" in described, "capture.json" in described) == (True, False), name


def test_exit_codes_agree_between_readme_docstring_and_help() -> None:
    table = re.findall(
        r"^\| (\d+) \| (.*) \|$", README.partition("| exit code | |")[2].partition("\n\n")[0], re.M
    )
    assert [code for code, _ in table] == ["0", "1", "2", "3", "4", "130"]
    import services.cli

    for text in (services.cli.__doc__, main.help):
        assert text is not None
        assert re.findall(r"\b(\d+) [a-z]", text.partition("Exit codes:")[2]) == [code for code, _ in table]


def test_exit_code_0_after_success() -> None:
    with scripted_server(lambda n: ok()) as (url, _):
        done = envmatte("status", "j", "--url", url)
        assert (done.returncode, done.stdout) == (0, "running recovering 50%\n")
        assert json.loads(envmatte("status", "j", "--url", url, "--json").stdout) == JOB
    with scripted_server(lambda n: ok(JOB | {"state": "failed", "stage": "failed"})) as (url, _):
        assert envmatte("status", "j", "--url", url).stdout == "failed\n"


def test_exit_code_1_if_refused_failed_or_not_written(tmp_path: Path) -> None:
    with scripted_server(lambda n: refusal(404)) as (url, _):
        found = envmatte("status", "j", "--url", url)
    assert (found.returncode, found.stdout, found.stderr) == (1, "", "Error: why, and what to do\n")
    failed = JOB | {"state": "failed", "problem": {"detail": "no light"}}
    with scripted_server(lambda n: ok(failed)) as (url, _):
        found = envmatte("wait", "j", "--url", url)
    assert (found.returncode, found.stdout) == (1, "")
    assert "no light" in found.stderr
    (tmp_path / "backdrop.png").write_bytes(b"any")
    output = tmp_path / "nowhere" / "out.png"
    with scripted_server(lambda n: ok()) as (url, calls):
        for command in (["composite", "m", str(tmp_path / "backdrop.png")], ["export", "m"], ["demo"]):
            found = envmatte(*command, "-o", str(output), "--url", url)
            assert found.returncode == 1
            assert f"there is no folder {output.parent}; make it first" in found.stderr
        assert not calls


def test_errors_name_commands_in_place_of_calls() -> None:
    detail = "there is no capture 'nope'; GET /v1/captures lists them"
    with scripted_server(lambda n: refusal(404, detail)) as (url, _):
        found = envmatte("recover", "nope", "--url", url)
    assert found.stderr == "Error: there is no capture 'nope'; `envmatte list captures` lists them\n"


def test_errors_do_not_command_the_terminal() -> None:
    with scripted_server(lambda n: refusal(422, "a\x1b[2J\x9b31m\x1b]0;title\x07.png")) as (url, _):
        assert (
            envmatte("status", "j", "--url", url).stderr == "Error: a\\x1b[2J\\x9b31m\\x1b]0;title\\x07.png\n"
        )
    wrong = envmatte("status", "j", "--url", "http://\x1b[2J")
    assert wrong.returncode == 2
    assert "\x1b" not in wrong.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        ["status"],
        ["upload", "no-such-file"],
        ["status", "j", "--url", "localhost:8000"],
        ["worker"],
        ["scheduler", "--host", "0.0.0.0"],
    ],
    ids=" ".join,
)
def test_exit_code_2_for_a_wrong_command_line(arguments: list[str]) -> None:
    found = envmatte(*arguments)
    assert (found.returncode, found.stdout) == (2, "")
    assert "Error: " in found.stderr
    assert "python -m" not in found.stderr


def test_url_and_key_come_from_the_environment_or_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with scripted_server(lambda n: ok()) as (url, calls):
        Path(".env").write_text(f"ENVMATTE_URL={url}\nENVMATTE_KEY=of-the-file\n")
        for environment, options in (
            ({}, []),
            ({"ENVMATTE_KEY": "of-the-environment"}, []),
            ({"ENVMATTE_KEY": "of-the-environment"}, ["--key", "given"]),
        ):
            where = os.environ | {"PYTHONPATH": str(ROOT)} | environment
            subprocess.run([*COMMAND, "status", "j", *options], check=True, timeout=300, env=where)
        keys = [call["Authorization"].removeprefix("Bearer ") for call in calls]
    assert keys == ["of-the-file", "of-the-environment", "given"]


def test_exit_code_4_and_no_data_folder_if_the_port_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        data, port = tmp_path / "data", taken.getsockname()[1]
        found = envmatte("serve", "--data", str(data), "--port", str(port))
    assert (found.returncode, found.stdout, data.exists()) == (4, "", False)
    assert "choose another port with --port" in found.stderr


def test_exit_code_3_if_unreachable_or_busy() -> None:
    found = envmatte("status", "j", "--url", "http://127.0.0.1:9")
    assert (found.returncode, found.stdout) == (3, "")
    assert "envmatte serve" in found.stderr
    with scripted_server(lambda n: refusal(429, **{"Retry-After": "3600"})) as (url, _):
        assert envmatte("status", "j", "--url", url).returncode == 3


def interrupted(command: list[str], arrived: threading.Event) -> tuple[int, str]:
    """Run a command and interrupt it once a request has arrived; returns its exit code and the end of its stderr."""
    with running(command) as process:
        assert arrived.wait(120)
        return interrupt(process)


def test_exit_code_130_and_no_files_after_interrupted_layers(tmp_path: Path) -> None:
    arrived, finished = threading.Event(), threading.Event()
    matte = {"id": "m", "state": "ready", "created_at": "", "capture": None, "job": None, "options": {}}
    matte |= {"width": 1, "height": 1, "monitor": [1, 1]}

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "layers/rho" in self.path:  # the fourth of six
                arrived.set()
                finished.wait(60)
                return
            body = b"pixels" if "layers" in self.path else json.dumps(matte).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments: object) -> None:
            pass

    with web_server(Slow) as url:
        command = [*COMMAND, "layers", "m", str(tmp_path / "out"), "--url", url]
        code, stderr = interrupted(command, arrived)
        finished.set()
    assert (code, list(tmp_path.iterdir())) == (130, [])
    assert stderr.endswith("Interrupted.\n")


def test_exit_code_130_and_a_cancelled_job_after_an_interrupted_clip(tmp_path: Path) -> None:
    arrived = threading.Event()

    def answer(n: int):  # type: ignore[no-untyped-def]
        if n == 3:
            arrived.set()
        return ok()

    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"\0\0\0\x18ftypisom" + bytes(100))
    with scripted_server(answer) as (url, calls):
        output = tmp_path / "out.mp4"
        code, _ = interrupted(
            [*COMMAND, "composite", "m", str(clip), "-o", str(output), "--url", url], arrived
        )
    assert code == 130
    assert calls[-1]["call"] == "POST /v1/jobs/j/cancel"
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


def test_exit_code_130_and_a_way_to_continue_after_an_interrupted_recovery() -> None:
    arrived = threading.Event()

    def answer(n: int):  # type: ignore[no-untyped-def]
        if n == 3:
            arrived.set()
        return ok()

    with scripted_server(answer) as (url, calls):
        code, stderr = interrupted([*COMMAND, "recover", "c", "--url", url], arrived)
    assert code == 130
    assert "envmatte wait j" in stderr
    assert not any("cancel" in call["call"] for call in calls)


def test_a_service_that_stops_while_a_command_waits_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("services.client._session.PATIENCE", 0.5)
    with scripted_server(lambda n: ok() if n < 2 else None) as (url, _):
        given_up = CliRunner().invoke(main, ["recover", "c", "--url", url])
    assert isinstance(given_up.exception, Unreachable)
    assert "The job continues when the service does: envmatte wait j" in given_up.stderr
    assert [record.getMessage() for record in caplog.records if "trying again" in record.getMessage()] == [
        f"no answer from {url}; trying again for 0.5 s"
    ]


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize(
    ("command", "model"),
    [
        ("serve", Settings),
        ("coordinator", CoordinatorSettings),
        ("scheduler", SchedulerSettings),
        ("worker", ClusterSettings),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_help_of_a_process_lists_its_settings(
    command: str, model: type[SchedulerSettings], width: int
) -> None:
    text = CliRunner().invoke(main, [command, "--help"], terminal_width=width).output
    assert max(map(len, text.splitlines())) <= width
    words = " ".join(text.split())
    described = describe_settings(model)
    assert set(re.findall(r"\bENVMATTE_\w+", text)) == {one.variable for one in described}
    for one in described:
        assert f"{one.variable} {one.description} [default: {one.default}]" in words


def imported(*arguments: str, folder: Path) -> set[str]:
    """The top-level modules that a command imports while it runs."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-X", "importtime", "-m", "services", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder, env=environment)
    assert done.returncode in (0, 3), done.stderr[-2000:]
    return {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}


@pytest.mark.parametrize("command", [["--help"], ["serve", "--help"], ["demo", "--help"]], ids=" ".join)
def test_help_imports_nothing_heavy(command: list[str], tmp_path: Path) -> None:
    assert "click" in (found := imported(*command, folder=tmp_path))
    assert not found & (HEAVY | {"sqlalchemy", "httpx2"})


def test_listing_keys_imports_nothing_heavy(tmp_path: Path) -> None:
    imported("keys", "make", "lab", folder=tmp_path)  # makes the database, with alembic
    assert "sqlalchemy" in (found := imported("keys", "list", folder=tmp_path))
    assert not found & (HEAVY | {"pydantic"})


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"\0\0\0\x18ftypisom", "clip"),
        (b"\0\0\0\x08wide\0\0\0\0", "clip"),
        (b"\x1aE\xdf\xa3", "clip"),
        (b"RIFF\0\0\0\0AVI LIST", "clip"),
        (b"\x47\x40\0\x10" + bytes(184) + b"\x47", "clip"),
        (b"\0\0\0\0\x47\x40\0\x10" + bytes(188) + b"\x47", "clip"),
        (b"\0\0\0\x18ftypheic", "still"),
        (b"\0\0\0\x18ftypcrx ", "still"),
        (b"\x89PNG\r\n\x1a\n", "still"),
        (b"GIF89a", "still"),
        (b"GIF89a" + bytes(182) + b"\x47", "still"),
        (b"RIFF\0\0\0\0WEBP", "still"),
        (b"", "still"),
    ],
)
def test_clips_and_stills_differ_by_their_first_bytes(tmp_path: Path, start: bytes, kind: str) -> None:
    file = tmp_path / "backdrop"
    file.write_bytes(start + bytes(300 if start else 0))
    output = tmp_path / "out.txt"
    answer = CliRunner().invoke(main, ["composite", "m", str(file), "-o", str(output)])
    assert answer.exit_code == 2
    assert ("must end in .mp4" in " ".join(answer.output.split())) == (kind == "clip")


@pytest.mark.parametrize("name", [str(command.name) for command in (*jobs.COMMANDS, *mattes.COMMANDS)])
def test_commands_that_talk_to_a_service_import_nothing_heavy(name: str, tmp_path: Path) -> None:
    for file in ("film.zip", "matte.zip", "backdrop.png"):
        (tmp_path / file).write_bytes(b"any")
    assert "httpx2" in (found := imported(name, *REMOTE[name], *UNREACHABLE, folder=tmp_path))
    assert not found & (HEAVY | {"sqlalchemy", "pydantic"})


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_works_in_its_shell(shell: str, tmp_path: Path) -> None:
    done = envmatte("completion", shell)
    assert done.returncode == 0
    assert f"_ENVMATTE_COMPLETE={shell}_complete" in done.stdout
    words = {"COMP_WORDS": "envmatte rec", "COMP_CWORD": "rec" if shell == "fish" else "1"}
    found = envmatte(_ENVMATTE_COMPLETE=f"{shell}_complete", **words)
    assert re.findall(r"\b[a-z]+\b", found.stdout)[:2] == ["plain", "recover"]
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed: its script was not run")
    (tmp_path / "script").write_text(done.stdout)
    subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)


def test_bash_completes_commands_and_options(tmp_path: Path) -> None:
    (tmp_path / "envmatte").write_text(f'#!/bin/sh\nexec {shlex.join(COMMAND)} "$@"\n')
    (tmp_path / "envmatte").chmod(0o755)
    script = """
eval "$(envmatte completion bash)"
complete -p envmatte
COMP_WORDS=(envmatte composite --tr) COMP_CWORD=2 COMPREPLY=()
_envmatte_completion envmatte
echo "${COMPREPLY[@]}"
"""
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env=os.environ | {"PATH": path}, timeout=60
    )
    assert done.stdout.splitlines()[-1] == "--transfer", done.stderr
    assert "_envmatte_completion envmatte" in done.stdout


@pytest.mark.parametrize("option", ["region=1", "webhook=https://x", "capture=c", "self=1", "options=1"])
def test_what_is_no_option_of_a_recovery_is_refused(option: str) -> None:
    done = CliRunner().invoke(main, ["recover", "c", "--option", option, *UNREACHABLE])
    assert done.exit_code == 2
    assert "is no option of a recovery" in done.stderr


@pytest.mark.parametrize("option", ["tile=1e400", "tile=NaN", "tile=[-Infinity]", 'method="\\ud800"'])
def test_an_option_that_json_does_not_have_is_refused(option: str) -> None:
    done = CliRunner().invoke(main, ["recover", "c", "--option", option, *UNREACHABLE])
    assert done.exit_code == 2
    assert "can't be sent as JSON" in done.stderr


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_numbers_are_finite(number: str) -> None:
    floats = [
        option
        for command in ALL.values()
        for option in command.params
        if isinstance(option.type, type(click.FLOAT))
    ]
    assert {"days", "until", "rate", "right"} <= {option.name for option in floats}
    for option in floats:
        with pytest.raises(click.BadParameter):
            option.type.convert(number, option, None)
    done = CliRunner().invoke(main, ["share", "m", "--days", number, *UNREACHABLE])
    assert (done.exit_code, "Invalid value for '--days'" in done.stderr) == (2, True)


@pytest.mark.parametrize("command", [["status", "j"], ["demo"]], ids=" ".join)
@pytest.mark.parametrize("key", ["secr\u00fct", "secret\n", "sec\x00ret", " secret"])
def test_a_key_that_cannot_be_sent_is_refused_without_being_shown(command: list[str], key: str) -> None:
    done = CliRunner().invoke(main, [*command, "--key", key, *UNREACHABLE])
    assert done.exit_code == 2
    assert "Invalid value for --key: the API key has" in done.stderr
    assert "secr" not in done.output


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["-o", "q.jpg"], "--output: q.jpg: the name must end in .png"),
        (["--workers", "0"], "'--workers': 0 is not in the range"),
        (["--url", "localhost:8000"], "--url: 'localhost:8000' is not the URL of a service"),
    ],
)
def test_wrong_options_of_the_demo_are_refused_before_it_begins(
    arguments: list[str], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.cli.demo_run.run", lambda *_, **__: pytest.fail("it began"))
    done = CliRunner().invoke(main, ["demo", *arguments])
    assert done.exit_code == 2
    assert reason in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("start", "code"), [(b"\x89PNG\r\n\x1a\n", 0), (b"\0\0\0\x18ftypisom", 2)], ids=["picture", "clip"]
)
def test_a_backdrop_from_a_pipe(tmp_path: Path, start: bytes, code: int) -> None:
    sent = start + bytes(300)
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(sent), daemon=True)
    writer.start()
    with scripted_server(lambda n: (200, {}, b"a composite")) as (url, calls):
        output = tmp_path / "out.png"
        command = ["composite", "m", str(tmp_path / "pipe"), "-o", str(output), "--url", url]
        done = CliRunner().invoke(main, command)
        writer.join(60)
    assert done.exit_code == code, done.output
    if code:
        assert "save it to a file" in done.stderr
    else:
        assert [call["body"] for call in calls] == [sent]


def test_a_file_without_a_program_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{}")
    file = str(tmp_path / "bad.json")
    for command in (
        ["patterns", file, str(tmp_path / "out")],
        ["pack", file, str(tmp_path), "-o", str(tmp_path / "x.zip")],
        ["tether", file, str(tmp_path)],
    ):
        done = CliRunner().invoke(main, command)
        assert done.exit_code == 2
        assert f"{file} has no program: monitor is required" in done.stderr


def test_what_commands_know_without_importing_the_service_is_what_it_has() -> None:
    assert remote_mattes.OF_PLATE == layers.OF_PLATE
    assert (keys.SCOPES, keys.DEFAULT) == (api_keys.SCOPES, owners.DEFAULT)
