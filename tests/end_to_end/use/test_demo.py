"""The demo, as a new user runs it."""

import json
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from PIL import Image

from tests.end_to_end.conftest import Service
from tests.end_to_end.mattes.test_layers import empty_pixels


@pytest.mark.exhaustive
@pytest.mark.slow
def test_demo_writes_its_picture_and_files(service: Service, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services", "demo", "-o", "picture.png", "--keep", "kept", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["psnr_db"] > 42.5
    assert figures["object_pixels"] > 10_000
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.width > 4 * picture.height
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["backdrop.png", "glass-ball.zip"]
    assert "done" in done.stderr
    uploaded = service.client.upload(tmp_path / "kept" / "glass-ball.zip")
    service.client.wait(uploaded["job"])
    matte = service.client.wait(service.client.recover(uploaded["id"])["id"])["matte"]
    assert empty_pixels(service, matte) == 0


@pytest.mark.exhaustive
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
def test_service_of_a_killed_demo_ends(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from services.cli.demo_run import service\n"
        "with service(Path(sys.argv[1], 'data'), 1) as url: print(url, flush=True); time.sleep(300)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        assert demo.stdout.readline().startswith("http://127.0.0.1:")
        family = psutil.Process(demo.pid).children(recursive=True)
        assert len(family) > 1
        demo.kill()
    _, alive = psutil.wait_procs(family, timeout=120)
    assert alive == []
