"""Confinement: its numbers are those of Linux's headers, and what a machine lacks is said."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from workflows.untrusted import confinement
from workflows.untrusted.confinement import CALLS, LEGACY, LIMITED

X86 = Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h")
ARM = Path("/usr/include/asm-generic/unistd.h")


def defined(header: Path) -> dict[str, int]:
    if not header.exists():
        pytest.skip(f"{header}, of Debian's linux-libc-dev, is not installed")
    found = re.findall(r"#define __NR(?:3264)?_(\w+) (\d+)", header.read_text())
    return {name: int(number) for name, number in found}


def test_numbers_of_system_calls_are_those_of_linux() -> None:
    numbers = {name: x86 for name, (x86, _) in (CALLS | LIMITED).items()} | LEGACY
    headers = defined(X86)
    assert numbers == {name: headers[name] for name in numbers}


def test_numbers_of_system_calls_are_those_of_linux_on_arm() -> None:
    numbers = {name: arm for name, (_, arm) in (CALLS | LIMITED).items()}
    headers = defined(ARM)
    assert numbers == {name: headers["fstatat" if name == "newfstatat" else name] for name in numbers}


@pytest.mark.skipif(confinement.missing() is not None, reason=str(confinement.missing()))
def test_machine_that_lacks_something_says_what_and_what_to_do() -> None:
    """A confined process is refused the calls of Landlock and seccomp, as by the profile of a container."""
    script = (
        "from workflows.untrusted.confinement import *; confine(); print(missing(), flush=True); confine()"
    )
    said = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    assert "not confined" in said
    assert "Landlock" in said
    assert "seccomp" in said
    assert "people you trust" in said
