"""Scenes: what a camera sees of them, and the captures of it."""

import io
import json
import zipfile
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from storage.errors import OptionError
from tests.parts.captures import nested_program
from workflows.images.tone_curves import to_light
from workflows.programs.parts import Bernoulli, Constant, Images, Monitor, Stripes
from workflows.programs.program import Program
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.scene import Scene, write_capture


@pytest.fixture(scope="module")
def ball() -> Scene:
    return glass_ball(48, 36, monitor=(96, 72), rays=16, index=(1.49, 1.5, 1.52), absorption=(0.1, 0.0, 0.3))


@pytest.fixture(scope="module")
def program() -> Program:
    return Program(
        monitor=Monitor(width=96, height=72),
        parts=(
            Constant(kind="constant", levels=(0.0, 0.4, 1.0)),
            Bernoulli(kind="bernoulli", columns=8, rows=6, count=70, seed=3),
            Bernoulli(kind="bernoulli", columns=13, rows=11, count=4, seed=4, colour="rgb"),
            Bernoulli(kind="bernoulli", columns=13, rows=11, count=3, seed=5, colour="rgb", offset=True),
            Bernoulli(kind="bernoulli", columns=8, rows=6, count=3, seed=6, offset=True),
            Stripes(kind="stripes", axis="x", count=6),
            Stripes(kind="stripes", axis="y", count=2, first=3),
        ),
    )


def test_a_constant_backdrop_arrives_by_rho(ball: Scene) -> None:
    for shape in ((1, 1, 3), (5, 7, 1), (72, 96, 3), (90, 200, 3)):
        arriving = ball.composite(np.full(shape, 0.7, np.float32))
        assert arriving.dtype == np.float32
        np.testing.assert_allclose(arriving, 0.7 * ball.rho, atol=1e-6)


def test_a_composite_is_the_transport_of_the_backdrop(ball: Scene) -> None:
    light = backdrop(96, 72)
    plain = np.stack([ball.transport[c].toarray() @ light[..., c].ravel() for c in range(3)], axis=1)
    np.testing.assert_allclose(ball.composite(light).reshape(-1, 3), plain, atol=1e-5)
    truth = ball.truth(light, offset=0.1, gain=0.5)
    assert truth.dtype == np.float32
    np.testing.assert_allclose(truth.reshape(-1, 3), 0.1 + 0.5 * plain, atol=1e-5)


def test_a_frame_without_noise_is_the_transport_of_the_pattern(ball: Scene, program: Program) -> None:
    frames = list(ball.film(program, offset=0.05, gain=0.8, noise=0, depth=16))
    assert len(frames) == program.count
    for n, frame in enumerate(frames):
        assert frame.shape == (36, 48, 3)
        assert frame.dtype == np.uint16
        (shown,) = program.pictures(n, n + 1)
        light = [ball.transport[c] @ shown[..., min(c, shown.shape[2] - 1)].ravel() for c in range(3)]
        value = 0.05 + 0.8 * np.stack(light, axis=1).reshape(36, 48, 3)
        np.testing.assert_allclose(frame / 65535, value, atol=0.51 / 65535)


def test_curves_of_monitor_and_camera_are_followed(ball: Scene) -> None:
    def one(response: str) -> Program:
        part = {"kind": "constant", "levels": [0, 0.5]}
        image = {"kind": "images", "files": ["a.png"]}
        monitor = {"width": 96, "height": 72, "response": response}
        return Program.model_validate({"monitor": monitor, "parts": [part, image]})

    picture = np.linspace(0, 1, 7 * 9, dtype=np.float32).reshape(7, 9, 1)
    frames = list(ball.film(one("srgb"), noise=0, depth=16, response="srgb", images=[picture]))
    values = [to_light((f / 65535).astype(np.float32), "srgb") for f in frames]
    np.testing.assert_allclose(values[1], 0.02 + 0.9 * 0.21404 * ball.rho, atol=3e-5)
    stretched = picture[np.arange(72)[:, None] * 7 // 72, np.arange(96) * 9 // 96]
    np.testing.assert_allclose(values[2], ball.truth(to_light(stretched, "srgb")), atol=3e-5)
    unknown = list(ball.film(one("unknown"), noise=0, depth=16, response="srgb", images=[picture]))
    np.testing.assert_array_equal(unknown, frames)


def test_noise_is_the_sensors() -> None:
    scene = glass_ball(8, 6, monitor=(8, 6), rays=1, index=1.0)
    levels = (0.0,) * 1000 + (0.5,) * 1000
    parts = (
        Constant(kind="constant", levels=levels),
        Bernoulli(kind="bernoulli", columns=2, rows=2, count=1, seed=0),
    )
    program = Program(monitor=Monitor(width=8, height=6), parts=parts)
    frames = np.array(list(scene.film(program, noise=2.0, depth=16)), np.float64)[:2000] / 65535
    for level, some in ((0.0, frames[:1000]), (0.5, frames[1000:])):
        value = 0.02 + 0.9 * level
        deviation = 2 * (0.002 + 0.006 * np.sqrt(value))
        assert some.mean() == pytest.approx(value, abs=5 * deviation / np.sqrt(some.size))
        assert some.std() == pytest.approx(deviation, rel=0.02)
        assert abs(np.corrcoef(some[:-1].ravel(), some[1:].ravel())[0, 1]) < 0.02


def test_the_seed_decides_everything(program: Program) -> None:
    def capture(seed: int) -> bytes:
        scene = glass_ball(24, 18, monitor=(96, 72), rays=4, seed=seed)
        target = io.BytesIO()
        write_capture(scene, program, target, mask=True, seed=seed)
        return target.getvalue()

    assert capture(1) == capture(1)
    assert capture(1) != capture(2)


@pytest.mark.parametrize(("depth", "dtype"), [(8, np.uint8), (16, np.uint16)])
def test_a_capture_holds_what_its_format_says(
    ball: Scene, program: Program, tmp_path: Path, depth: int, dtype: type
) -> None:
    image = np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 4, 3)
    parts = (*program.parts, Images(kind="images", files=("shown/one.png", "two.png")))
    program = Program(monitor=program.monitor, parts=parts)
    options = {"depth": depth, "response": "srgb", "noise": 0.5, "images": (image, image[:, :, :1])}
    path = tmp_path / "ball.zip"
    count = write_capture(ball, program, path, mask=True, name="ball", **options)  # type: ignore[arg-type]
    filmed = list(ball.film(program, **options))  # type: ignore[arg-type]
    assert count == program.count == len(filmed)
    with zipfile.ZipFile(path) as archive:
        manifest = json.loads(archive.read("capture.json"))
        assert manifest["format"] == "envmatte-capture/1"
        assert manifest["name"] == "ball"
        assert manifest["response"] == "srgb"
        assert Program.model_validate(manifest["program"]) == program
        assert [frame["pattern"] for frame in manifest["frames"]] == list(range(count))
        names = [frame["file"] for frame in manifest["frames"]]
        assert names[:2] == ["frames/00000.png", "frames/00001.png"]
        others = {"capture.json", "mask.png", "shown/one.png", "two.png"}
        assert set(archive.namelist()) == {*names, *others}
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        for name, frame in zip(names, filmed, strict=True):
            stored = imagecodecs.png_decode(archive.read(name))
            assert stored.dtype == dtype
            np.testing.assert_array_equal(stored, frame)
        mask = imagecodecs.png_decode(archive.read("mask.png"))
        np.testing.assert_array_equal(mask, np.where(ball.object_mask, 255, 0))
        one, two = (
            imagecodecs.png_decode(archive.read(name)) / 65535 for name in ("shown/one.png", "two.png")
        )
        np.testing.assert_allclose(one, image, atol=1e-5)
        np.testing.assert_allclose(two, image[:, :, 0], atol=1e-5)


def test_what_does_not_fit_is_refused_and_nothing_written(
    ball: Scene, program: Program, tmp_path: Path
) -> None:
    path = tmp_path / "ball.zip"
    with pytest.raises(OptionError, match="monitor has another size"):
        write_capture(ball, nested_program((64, 48), bands=((8, 6, 2),)), path)
    with pytest.raises(OptionError, match="needs 0 images, not 1"):
        write_capture(ball, program, path, images=(np.ones((2, 2, 1), np.float32),))
    assert not path.exists()
    with pytest.raises(OptionError, match="must be a square number"):
        glass_ball(rays=50)


def test_frames_may_be_jpeg_and_the_mask_another(ball: Scene, program: Program) -> None:
    mask = ball.coverage > 0
    film = {"noise": 0.0, "response": "srgb"}
    write_capture(ball, program, file := io.BytesIO(), mask=mask, jpeg=95, **film)  # type: ignore[arg-type]
    with zipfile.ZipFile(file) as archive:
        manifest = json.loads(archive.read("capture.json"))
        np.testing.assert_array_equal(imagecodecs.imread(archive.read("mask.png")) > 0, mask)
        expected = list(ball.film(program, **film))  # type: ignore[arg-type]
        assert manifest["response"] == "srgb"
        for frame, exact in zip(manifest["frames"], expected, strict=True):
            content = archive.read(frame["file"])
            assert content.startswith(b"\xff\xd8")
            assert np.mean((imagecodecs.jpeg_decode(content) - exact.astype(float)) ** 2) < 25
