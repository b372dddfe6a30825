"""The command line against a real service."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from tests.end_to_end.conftest import Service, png
from workflows import images


def envmatte(service: Service, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services", *arguments, "--url", service.url]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_from_a_capture_to_a_composite(service: Service, bundle: Path, tmp_path: Path) -> None:
    uploaded = envmatte(service, "upload", str(bundle), "--name", "by hand")
    assert uploaded.returncode == 0, uploaded.stderr
    assert "upload: 100%" in uploaded.stderr
    capture = uploaded.stdout.strip()
    assert service.client.capture(capture)["name"] == "by hand"

    recovered = envmatte(service, "recover", capture, "--option", "tile=48", "--json")
    job = json.loads(recovered.stdout)
    assert (job["state"], job["options"]["tile"]) == ("succeeded", 48)
    assert "recovery: 100%" in recovered.stderr
    assert envmatte(service, "status", job["id"]).stdout.split() == ["succeeded", "succeeded", "1.0"]

    backdrop = tmp_path / "backdrop.png"
    backdrop.write_bytes(png(np.full((4, 4, 3), 0.5, np.float32), "srgb", np.uint8))
    composite = tmp_path / "composite.png"
    done = envmatte(service, "composite", job["matte"], str(backdrop), "-o", str(composite))
    assert done.stdout.strip() == str(composite)
    assert images.decode(composite.read_bytes(), memory=1 << 24).shape == (72, 96, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["backdrop.png", "composite.png"]


def test_what_the_service_refuses_is_told_with_exit_code_1(service: Service, tmp_path: Path) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"no zip")
    for arguments, said in (
        (["upload", str(broken)], "cut off"),
        (["recover", "no-such-capture"], "no-such-capture"),
        (["status", "no-such-job"], "no-such-job"),
    ):
        refused = envmatte(service, *arguments)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert said in refused.stderr
        assert "Traceback" not in refused.stderr


def test_a_wrong_command_line_has_exit_code_2(service: Service) -> None:
    for arguments in (
        ["recover"],
        ["upload", "no-such-file.zip"],
        ["recover", "x", "--option", "tile"],
        ["fly"],
    ):
        assert envmatte(service, *arguments).returncode == 2


def test_an_interrupt_stops_the_waiting_and_not_the_job(service: Service, capture: str) -> None:
    command = [sys.executable, "-m", "services", "recover", capture, "--url", service.url]
    waiting = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    newest = service.http.get("/v1/jobs?limit=1").json()["jobs"][0]["id"]
    while (job := service.http.get("/v1/jobs?limit=1").json()["jobs"][0])["id"] == newest:
        time.sleep(0.01)
    time.sleep(0.3)
    os.kill(waiting.pid, signal.SIGINT)
    _, said = waiting.communicate(timeout=20)
    assert waiting.returncode == 130
    assert "Interrupted" in said
    assert service.client.wait(job["id"])["state"] == "succeeded"
