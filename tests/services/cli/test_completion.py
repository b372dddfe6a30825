"""`envmatte completion`: its scripts, and what they complete."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.services.cli.commands import COMMAND, envmatte


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
