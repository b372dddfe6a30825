"""Commands that run processes: their help, a port that is taken, no folder for kernels."""

import os
import re
import socket
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from services.runtime.kernel_cache import require_kernel_cache
from services.settings import (
    ClusterSettings,
    CoordinatorSettings,
    SchedulerSettings,
    Settings,
    describe_settings,
)
from tests.services.cli.commands import envmatte


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


def test_exit_code_4_and_no_data_folder_if_the_port_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        data, port = tmp_path / "data", taken.getsockname()[1]
        found = envmatte("serve", "--data", str(data), "--port", str(port))
    assert (found.returncode, found.stdout, data.exists()) == (4, "", False)
    assert "choose another port with --port" in found.stderr
    assert "Traceback" not in found.stderr


def test_exit_code_2_if_others_could_reach_a_service_without_keys(tmp_path: Path) -> None:
    found = envmatte("serve", "--data", str(tmp_path / "data"), "--host", "0.0.0.0", ENVMATTE_KEYS="")
    assert (found.returncode, found.stdout) == (2, "")
    assert "envmatte keys make" in found.stderr
    assert "ENVMATTE_KEYS" in found.stderr


@pytest.mark.parametrize("command", ["serve", "coordinator", "worker", "warm"])
def test_command_without_a_folder_for_kernels_asks_for_one(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "access", lambda *given: False)
    refused = CliRunner().invoke(main, [command])
    assert (refused.exit_code, "set NUMBA_CACHE_DIR" in refused.stderr) == (1, True), refused.stderr


def test_a_folder_that_is_still_to_be_made_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda folder, mode: folder == tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new" / "cache"))
    require_kernel_cache()
