"""Captures with glare, with noise that constant frames don't tell, and with errors of the model: all are measured."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from storage.layout.captures import Stack
from tests.parts.captures import captured, nested_program
from workflows.images.tone_curves import to_light
from workflows.ingest.light.stack_attributes import monitor_curve_of
from workflows.ingest.pixel_sample import take_sample
from workflows.ingest.report.expected_psnr import model_error_of
from workflows.ingest.report.report import report
from workflows.ingest.trial import unexplained
from workflows.ingest.trial.trial_recovery import Calibrated
from workflows.programs.parts import Constant
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.camera.noise import LEAST_READ
from workflows.recovery.glare import WIDTHS
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene

Ingest = Callable[..., Stack]
WIDTH, HEIGHT, MONITOR = 80, 60, (160, 120)
NOISE = 0.004


@pytest.fixture(scope="module")
def scene() -> Scene:
    return glass_ball(WIDTH, HEIGHT, monitor=MONITOR, rays=4)


@pytest.fixture(scope="module")
def program() -> Program:
    """With two constant frames, which don't tell the noise."""
    bands = ((8, 6, 12), (16, 12, 12), (32, 24, 12), (80, 60, 16))
    return nested_program(MONITOR, bands=bands, levels=2)


def filmed(
    scene: Scene,
    program: Program,
    glare: float = 0.0,
    error: float = 0.0,
    channels: int = 3,
    noise: float = NOISE,
    shown: float = 1.0,
) -> bytes:
    """A capture: a share of the light comes through a broad Gaussian, and frames differ by a share of themselves.

    Constant frames show a share of the noise.
    """
    rng, sigma = np.random.default_rng(7), WIDTHS[1] * MONITOR[0]
    inside = gaussian_filter(np.ones(MONITOR[::-1]), sigma, mode="constant")[..., np.newaxis]

    def see(n: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        light = to_light(picture, "srgb")
        blurred = gaussian_filter(light, (sigma, sigma, 0), mode="constant") / inside
        seen = scene.composite(((1 - glare) * light + glare * blurred).astype(np.float32))
        if n in program.measured:
            seen = seen * (1 + error * rng.standard_normal((HEIGHT, WIDTH, 1)))
        value = (0.02 + 0.7 * seen)[..., :channels]
        seen_noise = noise if n in program.measured else shown * noise
        return value + seen_noise * rng.standard_normal(value.shape)

    return captured(program, see)


def deviation(stack: Stack) -> NDArray[np.float64]:
    """Of the noise at black and at half of full scale."""
    noise = stack.attributes["noise"]
    return np.sqrt(noise["read"] + noise["shot"] * np.array([0.0, 0.5]))


def test_nothing_is_found_where_there_is_nothing(scene: Scene, program: Program, ingest: Ingest) -> None:
    stack = ingest("c", filmed(scene, program))
    assert stack.attributes["glare"] is None
    assert stack.attributes["model_error"] < 0.006
    np.testing.assert_allclose(deviation(stack), NOISE, rtol=0.3)


def test_glare_is_measured(scene: Scene, program: Program, ingest: Ingest) -> None:
    shares = ingest("c", filmed(scene, program, glare=0.1)).attributes["glare"]
    assert sum(shares) == pytest.approx(0.1, abs=0.025)
    assert shares[1] > 0.06


def test_frames_of_black_and_white_alone_promise_nothing(
    scene: Scene, program: Program, ingest: Ingest
) -> None:
    def see(_: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        return np.where(scene.composite(to_light(picture, "srgb")) > 0.5, 1.0, 0.0)

    stack = ingest("c", captured(program, see))
    assert stack.attributes["pattern_error"] is None
    assert not any("nan" in finding.message for finding in report(stack.attributes, stack.frames).findings)


def test_shares_that_no_glare_has_are_left_out(
    scene: Scene, program: Program, ingest: Ingest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unexplained, "fit_shares", lambda *_: np.array([0, 0, 0, 1.35]))
    assert ingest("c", filmed(scene, program)).attributes["glare"] is None


@pytest.mark.parametrize("noise", [0.002, pytest.param(0.01, marks=pytest.mark.slow)])
def test_noise_is_measured_from_patterns(
    scene: Scene, program: Program, ingest: Ingest, noise: float
) -> None:
    stack = ingest("c", filmed(scene, program, channels=1, noise=noise))
    assert stack.attributes["assumed_noise"]
    np.testing.assert_allclose(deviation(stack), noise, rtol=0.3)


@pytest.mark.parametrize("shown", [1.0, 0.3])
def test_noise_that_constant_frames_hide_is_measured(
    scene: Scene, program: Program, ingest: Ingest, shown: float
) -> None:
    constant = Constant(kind="constant", levels=(0, 1, 0, 1, 0, 1))
    several = Program(monitor=program.monitor, parts=(constant, *program.parts[1:]))
    stack = ingest("c", filmed(scene, several, shown=shown))
    assert not stack.attributes["assumed_noise"]
    assert stack.attributes["noise_of_patterns"] == (shown < 1)
    np.testing.assert_allclose(deviation(stack), NOISE, rtol=0.3)


def test_channels_that_are_one_leave_the_noise_of_quantisation(
    scene: Scene, program: Program, ingest: Ingest
) -> None:
    """They differ by nothing, and frames in the wrong order are explained by nothing."""
    pictures, first = list(program.pictures(0, program.count)), int(program.measured[0])
    order = [*range(first), *np.random.default_rng(1).permutation(program.measured)]

    def see(n: int, _: NDArray[np.uint8]) -> NDArray[np.floating]:
        return np.repeat(0.02 + 0.7 * scene.composite(pictures[order[n]])[..., :1], 3, axis=2)

    stack = ingest("c", captured(program, see))
    assert stack.attributes["noise"]["read"] >= LEAST_READ
    assert model_error_of(stack.attributes) > 0.1


def test_error_of_the_model_is_what_channels_have_in_common(
    scene: Scene, program: Program, ingest: Ingest
) -> None:
    stack = ingest("c", filmed(scene, program, error=0.03))
    # half of the light is black, which has no error
    assert stack.attributes["model_error"] == pytest.approx(0.03 / np.sqrt(2), rel=0.3)
    np.testing.assert_allclose(deviation(stack), NOISE, rtol=0.4)


@pytest.mark.slow
def test_errors_of_compression_are_no_promise_and_limit_the_noise_of_a_film(
    scene: Scene, program: Program, ingest: Ingest
) -> None:
    """Compression's errors are alike in the channels and differ from pixel to pixel."""
    stack = ingest("c", filmed(scene, program, error=0.02))
    assert model_error_of(stack.attributes) == stack.attributes["model_error"] > 0.01
    stack.annotate(video={}, noise={"read": (5 * NOISE) ** 2, "shot": 0.0})
    sample = take_sample(stack)
    assert sample is not None
    capture = Calibrated(stack, program, monitor_curve_of(stack.attributes))
    patterns = lay_out(program, capture.monitor, [])
    unexplained.find_unexplained(capture, patterns, sample, np.zeros((stack.frames, 3)))
    assert stack.attributes["model_error"] > 0.01
    assert model_error_of(stack.attributes) < 0.5 * stack.attributes["model_error"]
    assert stack.attributes["noise_of_patterns"]
    assert deviation(stack)[1] < 3 * NOISE
