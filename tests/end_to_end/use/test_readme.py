"""The commands of the README, run as a new user would, with real processes."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import httpx2
import numpy as np
import pytest

from services.client import Client
from tests.docs.readmes import block
from tests.end_to_end.conftest import HEIGHT, TILES, WIDTH, png
from tests.parts.rig import free_port
from tests.parts.waiting import until
from workflows.simulation import glass_ball

URL = "http://127.0.0.1:8000"


@dataclass
class Home:
    """The folder in which a user has followed the README as far as `envmatte serve`."""

    folder: Path
    url: str
    client: Client

    def run(self, script: str, *arguments: str, **settings: str) -> str:
        """Run lines of shell there, and return what they print."""
        return subprocess.run(
            ["bash", "-euc", script.replace(URL, self.url), "bash", *arguments],
            cwd=self.folder,
            env=environment(ENVMATTE_URL=self.url, **settings),
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=580,
        ).stdout


def environment(**settings: str) -> dict[str, str]:
    """An environment with this interpreter's `envmatte` and `python3`, and one worker for each service."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return os.environ | {"PATH": path, "ENVMATTE_WORKERS": "1"} | settings


@contextmanager
def machine(script: str, folder: Path, **settings: str) -> Iterator[subprocess.Popen[str]]:
    """Run lines of shell in a folder and a process group of their own, as on another machine, until the block ends."""
    folder.mkdir(exist_ok=True)
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            ["bash", "-euc", script],
            cwd=folder,
            env=environment(**settings),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(30)
        assert process.stdout is not None
        process.stdout.close()


def url_of(serving: subprocess.Popen[str], folder: Path) -> str:
    """The URL that `envmatte serve` prints."""
    assert serving.stdout is not None
    while " at http" not in (line := serving.stdout.readline()):
        assert line, (folder / "log").read_text()
    return line.rsplit(" at ", 1)[1].strip()


def film(show: Path, target: Path) -> None:
    """What a camera of 80 x 60 pixels sees of a display that fills its picture, without glass and unclipped."""
    with av.open(str(show)) as source, av.open(str(target), "w") as out:
        source_stream = source.streams.video[0]
        stream = out.add_stream("libx264", rate=source_stream.average_rate, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = 80, 60, "yuv420p"
        for n, frame in enumerate(source.decode(source_stream)):
            pixels = frame.to_ndarray(format="rgb24").reshape(60, 4, 80, 4, 3).mean(axis=(1, 3))
            seen = av.VideoFrame.from_ndarray((16 + 0.8 * pixels).astype(np.uint8), "rgb24")
            seen.pts, seen.time_base = n, 1 / source_stream.average_rate
            out.mux(stream.encode(seen))
        out.mux(stream.encode(None))


@pytest.fixture(scope="module")
def home(capture_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    """A folder as after the install command, with a smaller capture, and the service, started as the README says."""
    folder = tmp_path_factory.mktemp("home")
    (folder / ".venv/bin").mkdir(parents=True)
    (folder / ".venv/bin/activate").write_text("")
    (folder / "demo").mkdir()
    shutil.copy(capture_archive, folder / "demo/glass-ball.zip")
    (folder / "demo/backdrop.png").write_bytes(png(glass_ball.backdrop(160, 120), "srgb", np.uint8))
    with ExitStack() as stack:
        script = block("README.md", "Your first composite")
        serving = stack.enter_context(machine(script, folder, ENVMATTE_PORT="0"))
        url = url_of(serving, folder)
        yield Home(folder, url, stack.enter_context(Client(url)))


def test_first_composite_by_command_curl_and_client(home: Home) -> None:
    home.run(block("README.md", "Your first composite", number=1))
    by_command = (home.folder / "composite.png").read_bytes()
    (home.folder / "composite.png").unlink()
    curl = block("README.md", "Your first composite", number=2)
    assert len(curl.splitlines()) == 5
    if shutil.which("curl") is None:
        pytest.skip("five lines of the README need curl, which is not installed")
    home.run(curl)
    assert (home.folder / "composite.png").read_bytes() == by_command
    newest = httpx2.get(f"{home.url}/v1/mattes?limit=1").json()["mattes"][0]
    assert home.client.composite(newest["id"], home.folder / "demo/backdrop.png") == by_command


@pytest.mark.slow
def test_from_a_film_to_composites(home: Home) -> None:
    show, pack = (
        block("README.md", "Film your own glass", number=n).replace("1920x1080", "320x240") for n in (0, 1)
    )
    home.run(show)
    film(home.folder / "show.mp4", home.folder / "film.mp4")
    (home.folder / "backdrops").mkdir()
    light = {name: glass_ball.backdrop(64, 48) * gain for name, gain in (("day", 1.0), ("night", 0.25))}
    for name, values in light.items():
        (home.folder / f"backdrops/{name}.png").write_bytes(png(values, "srgb", np.uint8))

    printed = home.run(f'{pack}{block("README.md", "Command line and Python")}echo "$capture $matte"\n')
    capture, matte = printed.split()[-2:]
    assert home.client.capture(capture)["name"] == "my glass"
    assert sorted(path.name for path in (home.folder / "layers").iterdir()) == sorted(
        ["all.exr", "stmap.exr", "S.png", "rho.png", "alpha.png", "confidence.png"]
    )
    assert sorted(path.stem for path in (home.folder / "composites").iterdir()) == ["day", "night"]
    for name in light:
        expected = home.client.composite(matte, home.folder / f"backdrops/{name}.png")
        assert (home.folder / f"composites/{name}.png").read_bytes() == expected

    (home.folder / "stripes.py").write_text(
        block("README.md", "Command line and Python", "python").replace(URL, home.url)
    )
    home.run(f"python3 stripes.py {matte}", PYTHONPATH=os.getcwd())
    with np.load(home.folder / "composites.npz") as made:
        assert (made["film"].shape, made["film"].dtype) == ((4, 60, 80, 3), np.float32)
        assert made["alpha"].shape == (60, 80)
        # The moving stripes of the display fill the picture.
        assert np.std(made["film"], axis=0).mean() > 0.05


@pytest.mark.slow
def test_service_scales_to_three_machines(capture_archive: Path, tmp_path: Path) -> None:
    port = free_port()
    first, others = (
        block("README.md", "Scale out", number=n)
        .replace("FIRST:8786", f"127.0.0.1:{port}")
        .replace("/mnt/envmatte", str(tmp_path / "shared"))
        .replace("envmatte scheduler", f"envmatte scheduler --port {port}")
        for n in (0, 1)
    )
    with ExitStack() as stack:
        serving = stack.enter_context(machine(first, tmp_path / "first", ENVMATTE_PORT="0"))
        url = url_of(serving, tmp_path / "first")
        for name in ("second", "third"):
            shutil.copytree(tmp_path / "first" / "certs", tmp_path / name / "certs")
            stack.enter_context(machine(others, tmp_path / name))
        until(lambda: len(httpx2.get(f"{url}/v1/cluster").json()["workers"]) == 2)
        with Client(url) as client:
            job = client.wait(client.recover(client.upload(capture_archive), tile=16))
            assert (job.state, job["tiles"]["done"]) == ("succeeded", TILES)
            assert client.composite(client.matte(job), np.ones((4, 4, 3), np.float32)).shape == (
                HEIGHT,
                WIDTH,
                3,
            )
    assert (tmp_path / "shared" / "mattes").is_dir()
