"""The command line without a service: its help, its exit codes, and the errors that it shows."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from services.cli.main import main
from tests.services.cli.commands import ALL, ROOT, UNREACHABLE, envmatte
from tests.services.client.servers import JOB, ok, refusal, scripted_server

README = (ROOT / "services/cli/README.md").read_text()
PROCESSES = {"serve", "coordinator", "scheduler", "worker", "completion"}
"""Commands that have no answer to print as JSON."""


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
        ["status", "j", "--url", "localhost:8000"],
        ["status", os.fsdecode(b"not UTF-8: \xe9"), *UNREACHABLE],
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


@pytest.mark.parametrize(
    "arguments",
    [
        ["list", "jobs", "--name", "glass"],
        ["export", "m", "-o", "glass.html"],
        ["upload", "film.mov"],
        ["upload", "no-such-file"],
        ["recover"],
        ["recover", "x", "--option", "tile"],
    ],
    ids=" ".join,
)
def test_arguments_that_fit_no_command_are_refused_before_a_request(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("film.mov").write_bytes(b"\0\0\0\x14ftypqt  ")
    refused = CliRunner().invoke(main, [*arguments, *UNREACHABLE])
    assert refused.exit_code == 2, refused.output


def test_exit_code_3_if_unreachable_or_busy() -> None:
    found = envmatte("status", "j", "--url", "http://127.0.0.1:9")
    assert (found.returncode, found.stdout) == (3, "")
    assert "envmatte serve" in found.stderr
    with scripted_server(lambda n: refusal(429, **{"Retry-After": "3600"})) as (url, _):
        assert envmatte("status", "j", "--url", url).returncode == 3


def test_command_ends_without_a_search_for_garbage() -> None:
    left = "atexit.register(lambda: print(len(gc.get_objects())))"
    program = f"import atexit, gc; from services.cli.main import run; {left}; run()"
    done = subprocess.run(
        [sys.executable, "-c", program, "--version"], capture_output=True, text=True, check=True
    )
    assert int(done.stdout.splitlines()[-1]) < 5000


def test_interrupt_while_modules_are_imported_shows_no_traceback() -> None:
    program = (
        "import signal, sys\n"
        "class Interrupt:\n"
        "    def find_spec(name, *_): name == 'services.client' and signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt)\n"
        "from services.__main__ import run\n"
        "run()"
    )
    ended = subprocess.run([sys.executable, "-c", program, "--version"], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (-signal.SIGINT, "")
