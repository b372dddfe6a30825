"""The commands of the READMEs in the folders of the code, run unchanged against a real service."""

import json
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from services.runtime.webhook_signature import headers_of, signing_key
from services.settings import Settings
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.docs.readmes import block, codes, table
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service
from tests.end_to_end.use.test_readme import URL, environment
from workflows.composite import composite
from workflows.images.resample import area_mean
from workflows.programs.files import load_program
from workflows.programs.program import Program
from workflows.simulation import glass_ball
from workflows.simulation.scene import Scene, write_capture


def run(script: str, folder: Path, **settings: str) -> str:
    """Run lines of shell in a folder, and return what they print."""
    command = ["bash", "-euc", script]
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment(**settings),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout


@pytest.mark.slow
def test_patterns_are_written_as_video_and_as_pictures(tmp_path: Path) -> None:
    for section in ("As a video", "As pictures"):
        run(block("workflows/programs/README.md", section).replace("1920x1080", "320x240"), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"patterns", "patterns.mp4", "patterns.json"}
    assert {"00000.png", "program.json"} < {path.name for path in (tmp_path / "patterns").iterdir()}


@pytest.mark.slow
def test_stills_of_a_tethered_camera_are_recovered(service: Service, scene: Scene, tmp_path: Path) -> None:
    run(block("workflows/programs/README.md", "As pictures").replace("1920x1080", "1280x960"), tmp_path)
    program = load_program(str(tmp_path / "patterns/program.json"))
    assert isinstance(program, Program)
    write_capture(scene, program, tmp_path / "ball.zip")
    with zipfile.ZipFile(tmp_path / "ball.zip") as source:
        for frame in json.loads(source.read("capture.json"))["frames"][:64]:
            (tmp_path / "stills").mkdir(exist_ok=True)
            (tmp_path / f"stills/{frame['pattern']:05}.png").write_bytes(source.read(frame["file"]))
    script = block("workflows/programs/README.md", "While the camera takes it").replace("40", "20")
    matte = service.client.matte(run(script, tmp_path, ENVMATTE_URL=service.url).strip())
    assert (matte.state, matte.width, matte.height) == ("ready", WIDTH, HEIGHT)


@pytest.mark.skipif(
    shutil.which("curl") is None, reason="the README's line needs curl, which is not installed"
)
def test_program_is_created_with_curl(service: Service, tmp_path: Path) -> None:
    line = block("workflows/programs/README.md", "In the browser").replace(URL, service.url)
    (program,) = re.findall(r'"id":"([^"]+)"', run(line, tmp_path))
    assert service.http.get(f"/v1/programs/{program}/play").headers["content-type"].startswith("text/html")


@pytest.mark.slow
def test_matte_is_exported_imported_and_read(service: Service, matte: str, tmp_path: Path) -> None:
    readme = "workflows/mattes/README.md"
    export = block(readme, "Moving a matte elsewhere").replace(URL, service.url)
    lines = (block(readme, "Layers for other tools") + export).replace("MATTE", matte)
    imported = run(lines, tmp_path, ENVMATTE_URL=service.url).split()[-1]
    assert service.client.matte(imported)["state"] == "ready"
    assert (tmp_path / "layers/all.exr").exists()

    printed = python(block("services/client/envmatte/README.md", "Open a matte", "python"), tmp_path)
    assert "confidence" in printed
    assert "lobe: 4" in printed
    reading, compositing = (block(readme, "Reading a matte without envmatte", "python", n) for n in (0, 1))
    printed = python(reading, tmp_path)
    answer = service.http.get(f"/v1/mattes/{matte}/transport?x=40&y=30").json()
    weights = [float(weight) for weight in re.findall(r"float32\(([\d.e-]+)\)\)", printed)]
    expected = sorted(cell["weight"][0] for cell in answer["cells"] if cell["weight"][0])
    np.testing.assert_allclose(sorted(weights), expected, rtol=1e-5)

    stored = Matte(Objects((service.data / "store").as_uri()), matte)
    backdrop = glass_ball.backdrop(160, 120)
    np.save(tmp_path / "light.npy", area_mean(backdrop, stored.columns, stored.rows))
    python(compositing, tmp_path)
    # The service rounds the weights of a row to 16 bits of its largest, and their errors add up.
    np.testing.assert_allclose(
        np.load(tmp_path / "composite.npy"), composite(stored, backdrop)[..., :3], atol=2e-5
    )


@pytest.mark.slow
def test_keys_are_made_and_backups_taken(tmp_path: Path) -> None:
    """In a data folder without a running service."""
    (keys,) = {block("README.md", "Run the service"), block("services/README.md", "Keys, owners, limits")}
    (backups,) = {block("README.md", "Security and backups"), block("storage/README.md", "Backups")}
    (tmp_path / "home").mkdir()
    printed = run(keys + backups.replace("/mnt/backups", str(tmp_path)), tmp_path / "home")
    assert re.search(r"^lab\s+alice\s+write", printed, re.M), printed
    assert {path.name for path in (tmp_path / "home").iterdir()} == {"envmatte-data", "elsewhere"}
    assert (tmp_path / "monday/manifest.jsonl").exists()


def test_completion_is_enabled(tmp_path: Path) -> None:
    lines = block("services/cli/README.md", "Shell completion")
    assert "envmatte" in run(f"{lines}complete -p envmatte", tmp_path)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the README's line needs openssl")
def test_webhook_is_verified_by_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = "services/webhooks/README.md"
    run(block(readme, "The secret"), tmp_path)
    monkeypatch.chdir(tmp_path)
    secret = Settings().webhook_secret or ""
    body, names = json.dumps({"job": {"id": "j"}}).encode(), {}
    exec(block(readme, "Verifying", "python"), names)
    headers = headers_of(signing_key(secret), "id", int(time.time()), body)
    assert names["receive"](secret, body, headers) == {"id": "j"}
    assert headers.keys() == {codes(name)[0] for name, _ in table(readme, "header", "holds")}


def test_metrics_are_those_documented(service: Service) -> None:
    documented = {
        name
        for names, _, _ in table("services/README.md", "metric", "labels", "counts")
        for name in codes(names)
    }
    families = text_string_to_metric_families(service.http.get("/metrics").text)
    # A family of counters has the name of its samples without their suffix.
    assert documented == {family.name + "_total" * (family.type == "counter") for family in families}


def python(script: str, folder: Path) -> str:
    """Run a block of Python in a folder, and return what it prints."""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, check=True, timeout=120, stdout=subprocess.PIPE, text=True
    )
    return done.stdout
