"""What the processes of a service import: a coordinator alone needs no HTTP API; and what that costs later."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.parts.processes import running
from tests.services.cli.commands import COMMAND

SEARCHED = """
import gc, os, signal, time
from services.cli.main import run

searched = []

def count(phase, of):
    if phase == "start" and of["generation"] == 2:
        searched.append(len(gc.get_objects()))

def report(number, frame):
    before = len(searched)
    while len(searched) == before:  # nothing is searched while another thread collects
        gc.collect()
        time.sleep(0.01)
    os.write(1, b"%d\\n" % max(searched))  # the service itself may be in print()

gc.callbacks.append(count)
signal.signal(signal.SIGUSR1, report)
run()
"""
"""Runs a command; on SIGUSR1 prints how many objects a full collection has searched at most."""


def loaded_by(*modules: str) -> set[str]:
    """Names of all modules that a new process has after it imported some."""
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    return set(done.stdout.split())


def test_no_route_is_imported_before_the_app() -> None:
    modules = {"services.api", "services.server", "services.coordinator.coordinator"}
    loaded = loaded_by(*modules)
    assert modules <= loaded
    assert not {name for name in loaded if name.startswith("services.api.")}
    assert not loaded & {"fastapi", "uvicorn"}


@pytest.mark.slow
def test_a_start_says_that_it_waits_for_the_store(tmp_path: Path) -> None:
    with socket.socket() as silent:  # takes connections, and answers none
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        keys = {"AWS_ENDPOINT_URL": url, "AWS_ACCESS_KEY_ID": "somebody", "AWS_SECRET_ACCESS_KEY": "secret"}
        options = ["--data", str(tmp_path), "--port", "0", "--store", "s3://bucket/prefix"]
        with running([*COMMAND, "serve", *options], env=os.environ | keys) as service:
            assert service.stderr is not None
            lines = iter(service.stderr.readline, "")
            assert any("the store s3://bucket/prefix has not answered for 5 s" in line for line in lines)


@pytest.mark.slow
def test_routes_are_imported_with_the_app() -> None:
    assert {"services.api.captures.captures", "fastapi"} <= loaded_by("services.api.app")


@pytest.mark.slow
def test_modules_are_not_searched_for_garbage(tmp_path: Path) -> None:
    options = ["--data", str(tmp_path), "--port", "0", "--workers", "1"]
    with running([sys.executable, "-c", SEARCHED, "serve", *options], stderr=None) as service:
        assert service.stdout is not None
        assert " at http" in service.stdout.readline()
        service.send_signal(signal.SIGUSR1)
        searched = int(service.stdout.readline())
        service.terminate()
        service.wait(60)
    assert searched < 100_000  # of 270,000
