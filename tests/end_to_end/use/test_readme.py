"""The README's commands, as a new user pastes them."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from services.settings import Settings
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.end_to_end.conftest import Service
from workflows.composite import composite
from workflows.images import integer_formats
from workflows.images.resample import area_mean
from workflows.simulation import glass_ball

README = (Path(__file__).parents[3] / "README.md").read_text()


@pytest.mark.skipif(
    shutil.which("curl") is None, reason="the README's lines need curl, which is not installed"
)
def test_the_five_lines_of_curl(service: Service, bundle: Path, tmp_path: Path) -> None:
    (lines,) = (block for block in re.findall(r"```sh\n(.*?)```", README, re.S) if "curl" in block)
    assert len(lines.splitlines()) == 5
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "glass-ball.zip").write_bytes(bundle.read_bytes())
    backdrop = integer_formats.to_integers(glass_ball.backdrop(160, 120), np.dtype(np.uint8))
    (tmp_path / "demo" / "backdrop.png").write_bytes(integer_formats.encode_png(backdrop))
    script = lines.replace("http://127.0.0.1:8000", service.url)
    subprocess.run(["bash", "-euc", script], cwd=tmp_path, check=True, timeout=120)
    (newest,) = service.http.get("/v1/mattes?limit=1").json()["mattes"]
    expected = service.client.composite(newest["id"], (tmp_path / "demo" / "backdrop.png").read_bytes())
    assert (tmp_path / "composite.png").read_bytes() == expected


def test_matte_is_read_and_composited_with_zarr_only(service: Service, matte: str, tmp_path: Path) -> None:
    look, lines = re.findall(r"```python\n(.*?)```", README.partition("## Taking a matte elsewhere")[2], re.S)
    service.client.export(matte, tmp_path / "matte.zip")
    stored = Matte(Objects((service.data / "store").as_uri()), matte)
    backdrop = glass_ball.backdrop(160, 120)
    np.save(tmp_path / "light.npy", area_mean(backdrop, stored.columns, stored.rows))
    subprocess.run([sys.executable, "-c", lines], cwd=tmp_path, check=True, timeout=120)
    expected = composite(stored, backdrop)[..., :3]
    np.testing.assert_allclose(np.load(tmp_path / "composite.npy"), expected, atol=1e-5)
    done = subprocess.run(
        [sys.executable, "-c", look], cwd=tmp_path, check=True, timeout=120, capture_output=True, text=True
    )
    pixel = service.http.get(f"/v1/mattes/{matte}/transport?x=40&y=30").json()
    weights = [float(weight) for weight in re.findall(r"float32\(([\d.e-]+)\)\)", done.stdout)]
    expected_weights = sorted(cell["weight"][0] for cell in pixel["cells"] if cell["weight"][0])
    np.testing.assert_allclose(sorted(weights), expected_weights, rtol=1e-5)


def test_every_test_it_names_exists() -> None:
    root = Path(__file__).parents[3]
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", README)
    assert len(named) > 10
    for file, test in named:
        assert f"\ndef {test}(" in (root / file).read_text(), (file, test)


def test_every_setting_is_documented() -> None:
    documented = set(re.findall(r"`ENVMATTE_(\w+)`", README))
    assert documented == {name.upper() for name in Settings.model_fields}
