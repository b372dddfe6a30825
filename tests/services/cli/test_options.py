"""Options that several commands share: the service and its key, numbers."""

import os
import subprocess
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from services.cli.main import main
from tests.services.cli.commands import ALL, COMMAND, ROOT, UNREACHABLE
from tests.services.client.servers import ok, scripted_server


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


@pytest.mark.parametrize("command", [["status", "j"], ["demo"]], ids=" ".join)
@pytest.mark.parametrize("key", ["secr\u00fct", "secret\n", "sec\x00ret", " secret"])
def test_a_key_that_cannot_be_sent_is_refused_without_being_shown(command: list[str], key: str) -> None:
    done = CliRunner().invoke(main, [*command, "--key", key, *UNREACHABLE])
    assert done.exit_code == 2
    assert "Invalid value for --key: the API key has" in done.stderr
    assert "secr" not in done.output


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
