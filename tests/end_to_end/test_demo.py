"""The demo, as a new user runs it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image


@pytest.mark.full
def test_the_demo_leaves_its_picture(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services", "demo", "-o", "picture.png", "--keep", "kept", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["psnr_db"] > 26
    assert figures["object_pixels"] > 10_000
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.width > 4 * picture.height
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["backdrop.png", "glass-ball.zip"]
    assert "done" in done.stderr
