"""The command line in a process of its own."""

import subprocess
import sys

from tests.end_to_end.conftest import Service


def envmatte(service: Service, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command against a service."""
    command = [sys.executable, "-m", "services", *arguments, "--url", service.url]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)
