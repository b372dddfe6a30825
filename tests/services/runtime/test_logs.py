"""Logs as text and as JSON: what others sent stays within its line."""

import json
import subprocess
import sys

import pytest

SENT = "frames/a\n2026-01-01 00:00:00,000 INFO services succeeded\r\x1b[2J\x9b31m\x1b]0;title\x07.png"
SCRIPT = f"""
import logging
from services.runtime.logs import configure_logging

configure_logging({{form!r}}, "INFO", "test")
logging.warning("failed: %s", {SENT!r})
try:
    raise ValueError({SENT!r})
except ValueError:
    logging.exception("an error")
"""


CLOSED = """
import time
from distributed import Client, LocalCluster
from services.runtime.logs import configure_logging

cluster = LocalCluster(n_workers=0, processes=False, dashboard_address=None)
client = Client(cluster.scheduler_address)
configure_logging("text", "INFO", "test")
cluster.close()
time.sleep(0.3)  # it looks for its scheduler now
client.close()
"""


def logged(form: str) -> str:
    return run(SCRIPT.format(form=form))


def run(script: str) -> str:
    command = [sys.executable, "-c", script]
    return subprocess.run(command, capture_output=True, timeout=120, check=True).stderr.decode()


@pytest.mark.parametrize("form", ["text", "json"])
def test_control_characters_are_escaped(form: str) -> None:
    assert not {*map(chr, range(32)), "\x7f", "\x9b"} - {"\n"} & {*logged(form)}


def test_text_cannot_forge_a_line() -> None:
    first, second, *trace = logged("text").splitlines()
    assert first.endswith(
        r"WARNING root failed: frames/a\n2026-01-01 00:00:00,000 INFO services succeeded\r"
        r"\x1b[2J\x9b31m\x1b]0;title\x07.png"
    )
    assert second.endswith("ERROR root an error")
    assert trace
    assert all(line.startswith("  ") for line in trace)


def test_json_keeps_what_was_sent() -> None:
    first, second = map(json.loads, logged("json").splitlines())
    assert first["message"] == f"failed: {SENT}"
    assert second["exception"].endswith(f"ValueError: {SENT}")


def test_client_that_is_closed_while_the_scheduler_is_away_logs_no_error() -> None:
    assert "CancelledError" not in run(CLOSED)
