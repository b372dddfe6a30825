"""The commands of the cookbook, run as written against real processes."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import av
import httpx2
import numpy as np
import pytest

from services.client import Client
from tests.end_to_end.conftest import Service, png
from tests.end_to_end.use.test_readme import README
from workflows.simulation import glass_ball

TASKS = ["Film", "Upload", "Recover", "Composite a folder of backdrops", "Scale out to three machines"]
RECIPES = dict(
    re.findall(
        r"^### (.*?)\n(.*?)(?=^##)",
        README.partition("\n## Cookbook\n")[2].partition("\n## ")[0] + "\n##",
        re.S | re.M,
    )
)


def blocks(task: str, language: str = "sh") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", RECIPES[task], re.S)


def environment(url: str) -> dict[str, str]:
    """Environment in which `envmatte` and `python3` are those of the tests, and the service is the given one."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return os.environ | {"PATH": path, "ENVMATTE_URL": url, "ENVMATTE_WORKERS": "1"}


def film(show: Path, target: Path) -> None:
    """What a camera of 160 x 120 pixels sees of a display that fills its picture, without glass and unclipped."""
    with av.open(str(show)) as source, av.open(str(target), "w") as out:
        given = source.streams.video[0]
        stream = out.add_stream("libx264", rate=given.average_rate, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for n, frame in enumerate(source.decode(given)):
            pixels = frame.to_ndarray(format="rgb24").reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
            seen = av.VideoFrame.from_ndarray((16 + 0.8 * pixels).astype(np.uint8), "rgb24")
            seen.pts, seen.time_base = n, 1 / given.average_rate
            out.mux(stream.encode(seen))
        out.mux(stream.encode(None))


def test_the_tasks() -> None:
    assert list(RECIPES) == TASKS
    assert "curl" not in "".join(RECIPES.values())


@pytest.mark.slow
def test_from_a_film_to_a_folder_of_composites(service: Service, tmp_path: Path) -> None:
    show, pack = (block.replace("1920x1080", "320x240") for block in blocks("Film"))
    within = {"cwd": tmp_path, "env": environment(service.url), "check": True, "timeout": 240}
    subprocess.run(["bash", "-euc", show], **within)
    film(tmp_path / "show.mp4", tmp_path / "film.mp4")
    (tmp_path / "backdrops").mkdir()
    light = {name: glass_ball.backdrop(64, 48) * gain for name, gain in (("day", 1.0), ("night", 0.25))}
    for name, values in light.items():
        (tmp_path / "backdrops" / f"{name}.png").write_bytes(png(values, "srgb", np.uint8))

    rest = [*blocks("Upload"), *blocks("Recover"), *blocks("Composite a folder of backdrops")]
    script = pack + "".join(rest) + 'echo "$capture $matte"\n'
    done = subprocess.run(["bash", "-euc", script], **within, stdout=subprocess.PIPE, text=True)
    capture, matte = done.stdout.split()[-2:]
    assert service.client.capture(capture)["name"] == "my glass"
    assert sorted(path.name for path in (tmp_path / "layers").iterdir()) == sorted(
        ["all.exr", "stmap.exr", "S.png", "rho.png", "alpha.png", "confidence.png"]
    )
    assert sorted(path.name for path in (tmp_path / "composites").iterdir()) == ["day.png", "night.png"]
    for name in light:
        expected = service.client.composite(matte, tmp_path / "backdrops" / f"{name}.png")
        assert (tmp_path / "composites" / f"{name}.png").read_bytes() == expected

    (lines,) = blocks("Composite a folder of backdrops", "python")
    lines = lines.replace("http://127.0.0.1:8000", service.url)
    subprocess.run([sys.executable, "-c", lines, matte], **within)
    with np.load(tmp_path / "composites.npz") as made:
        assert (made["film"].shape, made["film"].dtype) == ((4, 120, 160, 3), np.float32)
        assert made["alpha"].shape == (120, 160)
        # The moving stripes of the display fill the picture.
        assert np.std(made["film"], axis=0).mean() > 0.05


@contextmanager
def machine(script: str, folder: Path, **settings: str) -> Iterator[subprocess.Popen[str]]:
    """Run a script as if on its own machine: a process group in its own folder."""
    folder.mkdir(exist_ok=True)
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            ["bash", "-euc", script],
            cwd=folder,
            env=environment("") | settings,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(120)
        assert process.stdout is not None
        process.stdout.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


@pytest.mark.slow
def test_three_machines(bundle: Path, tmp_path: Path) -> None:
    port = free_port()
    first, others = (
        block.replace("FIRST:8786", f"127.0.0.1:{port}")
        .replace("/mnt/envmatte", str(tmp_path / "shared"))
        .replace("envmatte scheduler", f"envmatte scheduler --port {port}")
        for block in blocks("Scale out to three machines")
    )
    with ExitStack() as stack:
        serving = stack.enter_context(machine(first, tmp_path / "first", ENVMATTE_PORT="0"))
        assert serving.stdout is not None
        while " at http" not in (line := serving.stdout.readline()):
            assert line, (tmp_path / "first" / "log").read_text()
        url = line.rsplit(" at ", 1)[1].strip()
        for name in ("second", "third"):
            shutil.copytree(tmp_path / "first" / "certs", tmp_path / name / "certs")
            stack.enter_context(machine(others, tmp_path / name))
        deadline = time.monotonic() + 120
        while len(httpx2.get(f"{url}/v1/cluster").json()["workers"]) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.2)
        with Client(url) as client:
            job = client.wait(client.recover(client.upload(bundle), tile=16))
            assert (job.state, job["tiles"]["done"]) == ("succeeded", 30)
            assert client.composite(client.matte(job), np.ones((4, 4, 3), np.float32)).shape == (72, 96, 3)
    assert (tmp_path / "shared" / "mattes").is_dir()
