"""Layers read back by another library, and put together again without ours."""

import io
import tempfile
from collections.abc import Callable
from functools import partial
from typing import IO

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray

from storage.layout import mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from tests.parts.captures import nested_program
from workflows.composite import composite
from workflows.images import integer_formats
from workflows.images.float_formats import REC_709
from workflows.jobs import Task, run
from workflows.mattes import layers
from workflows.mattes.layers import confidence
from workflows.mattes.steps import STEPS
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture
from workflows.untrusted.limits import Limits

CROSSTALK = [[0.9, 0.1, 0], [0.05, 0.8, 0.15], [0.02, 0.18, 0.8]]
Layers = dict[str, NDArray[np.float32]]


def read(write: Callable[[IO[bytes]], None]) -> tuple[Layers, oiio.ImageSpec]:
    """The channels of an EXR that a function writes, and what its header says."""
    with tempfile.NamedTemporaryFile(suffix=".exr") as stored:
        write(stored)
        stored.flush()
        file = oiio.ImageInput.open(stored.name)
        assert file, oiio.geterror()
        spec = file.spec()
        pixels = file.read_image(oiio.FLOAT)
        file.close()
    return {name: pixels[..., c] for c, name in enumerate(spec.channelnames)}, spec


@pytest.fixture
def identity(objects: Objects) -> Matte:
    """Every pixel sees the monitor's pixel behind it, but for some that were not recovered or see nothing."""
    height, width = 30, 50
    matte = mattes.create(
        objects,
        "m",
        height=height,
        width=width,
        columns=width,
        rows=height,
        monitor=[50, 30],
        crosstalk=CROSSTALK,
    )
    rng = np.random.default_rng(0)
    S, rho = rng.random((2, height, width, 3), np.float32)
    recovered, seen = np.ones((2, height, width), bool)
    recovered[3:5, 7], seen[20, 30:33] = False, False
    seen &= recovered
    S[~recovered] = rho[~recovered] = 0
    cells = np.arange(height * width, dtype=np.uint32).reshape(height, width)
    for row, column in np.ndindex(matte.block_rows, matte.block_columns):
        at = matte.span(row, column)
        count = np.zeros((*seen[at].shape, 3), np.uint32)
        count[..., 0] = seen[at]
        cell = cells[at][seen[at]]
        error = np.where(seen[at], np.float32(0.01), np.float32(np.inf))
        block = Block(
            S[at], rho[at], error, recovered[at], seen[at], count, cell, np.ones(len(cell), np.float32)
        )
        matte.write(row, column, block)
    return matte


def test_an_identity_is_an_stmap_of_pixel_centres_from_the_bottom_left(identity: Matte) -> None:
    channels, spec = read(partial(layers.stmap, identity))
    assert set(channels) == {"R", "G", "B"}
    assert spec.format == oiio.FLOAT
    seen = identity.layer("count").any(axis=2)
    y, x = np.mgrid[:30, :50]
    np.testing.assert_array_equal(channels["R"], np.where(seen, ((x + 0.5) / 50), 0).astype(np.float32))
    # row 0 is the top, where v is largest
    np.testing.assert_allclose(channels["G"], np.where(seen, (30 - y - 0.5) / 30, 0), atol=1e-7)
    np.testing.assert_array_equal(channels["B"], seen)


def test_an_stmap_of_a_plate_points_at_the_frame(identity: Matte) -> None:
    sight = np.array([[1.6, 0.1, -0.3], [0.06, 1.7, -0.4], [0.08, -0.05, 1]])
    channels, _ = read(lambda file: layers.stmap(identity, file, np.linalg.inv(sight)))
    seen = channels["B"] > 0
    y, x = np.mgrid[:30, :50]
    frame = np.stack([channels["R"], 1 - channels["G"], np.ones_like(channels["R"])], axis=-1)
    monitor = frame @ sight.T
    monitor /= monitor[..., 2:]
    np.testing.assert_allclose(monitor[seen, 0], (x[seen] + 0.5) / 50, atol=1e-6)
    np.testing.assert_allclose(monitor[seen, 1], (y[seen] + 0.5) / 30, atol=1e-6)
    np.testing.assert_array_equal(seen, identity.layer("count").any(axis=2))
    assert not channels["R"][~seen].any()
    assert not channels["G"][~seen].any()


@pytest.mark.parametrize("name", layers.NAMES)
def test_single_layers_equal_the_data_of_the_matte(identity: Matte, name: str) -> None:
    held = {
        "S": identity.layer("S"),
        "rho": identity.layer("rho"),
        "alpha": identity.layer("recovered")[..., np.newaxis],
        "confidence": confidence(identity)[..., np.newaxis],
    }[name]
    encoded = io.BytesIO()
    layers.png(identity, name, encoded)
    pixels = integer_formats.decode(encoded.getvalue(), memory=1 << 20)
    assert pixels.dtype == np.uint16
    np.testing.assert_allclose(integer_formats.to_unit(pixels), held, atol=1e-5)
    channels, spec = read(partial(layers.exr, identity, name))
    assert spec.format == oiio.FLOAT
    np.testing.assert_array_equal(
        np.stack([channels[c] for c in ("RGB" if held.shape[2] == 3 else "Y")], axis=-1), held
    )


def test_all_layers_are_read_back_from_one_exr(identity: Matte) -> None:
    channels, spec = read(partial(layers.everything, identity, lobes=2))
    of_lobe = ("u", "v", "weight.R", "weight.G", "weight.B", "sigma_u", "sigma_v", "theta")
    assert set(channels) == {
        *"RGBA",
        *(f"{name}.{c}" for name in ("S", "rho") for c in "RGB"),
        "confidence.Y",
        *(f"lobe{k}.{name}" for k in range(2) for name in of_lobe),
    }
    types = dict(zip(spec.channelnames, spec.channelformats, strict=True))
    assert types["lobe0.u"] == types["lobe1.v"] == oiio.FLOAT
    assert types["S.R"] == types["lobe0.sigma_u"] == oiio.HALF
    np.testing.assert_allclose(np.reshape(spec.getattribute("crosstalk"), (3, 3)), CROSSTALK, rtol=1e-6)
    np.testing.assert_allclose(spec.getattribute("chromaticities"), REC_709, rtol=1e-6)
    assert tuple(spec.getattribute("monitor")) == (50, 30)
    for c, channel in enumerate("RGB"):
        np.testing.assert_allclose(channels[f"S.{channel}"], identity.layer("S")[..., c], atol=3e-4)
        np.testing.assert_allclose(channels[f"rho.{channel}"], identity.layer("rho")[..., c], atol=3e-4)
        white = composite(identity, np.ones((1, 1, 3), np.float32))
        np.testing.assert_allclose(channels[channel], white[..., c], atol=1e-3)
    seen = identity.layer("count").any(axis=2)
    np.testing.assert_array_equal(channels["A"], identity.layer("recovered"))
    np.testing.assert_allclose(channels["confidence.Y"], 0.5 * seen, atol=3e-4)
    np.testing.assert_array_equal(channels["lobe0.weight.G"], seen)
    np.testing.assert_allclose(channels["lobe0.sigma_u"], seen / 50 / np.sqrt(12), rtol=1e-3)
    assert not any(channels[f"lobe1.{name}"].any() for name in of_lobe)


def test_size_of_all_layers_is_known_beforehand(identity: Matte) -> None:
    for lobes in (1, 4):
        _, spec = read(partial(layers.everything, identity, lobes=lobes))
        assert spec.pixel_bytes(True) * 30 * 50 == layers.bytes_of_everything(50, 30, lobes)


def recomposite(channels: Layers, crosstalk: NDArray[np.float64], backdrop: NDArray[np.float32]) -> NDArray:
    """The recipe of `workflows.mattes.layers`: each lobe is the Gaussian mean of the pixels under it."""
    height, width = backdrop.shape[:2]
    arrived = np.zeros((*channels["A"].shape, 3))
    lobes = sum(name.endswith(".theta") for name in channels)
    for k in range(lobes):
        of = {
            name: channels[f"lobe{k}.{name}"].astype(float)
            for name in ("u", "v", "sigma_u", "sigma_v", "theta")
        }
        weight = np.stack([channels[f"lobe{k}.weight.{c}"] for c in "RGB"], axis=-1)
        for y, x in np.argwhere(weight.any(axis=-1)):
            at, up = of["u"][y, x] * width - 0.5, (1 - of["v"][y, x]) * height - 0.5
            # a pixel of the backdrop has an extent of its own, which is in sigma too
            major, minor = (
                np.sqrt(max((of[s][y, x] * width) ** 2 - 1 / 12, 0.04)) for s in ("sigma_u", "sigma_v")
            )
            reach = int(3.5 * max(major, minor)) + 2
            rows = np.arange(max(int(up) - reach, 0), min(int(up) + reach, height - 1) + 1)
            columns = np.arange(max(int(at) - reach, 0), min(int(at) + reach, width - 1) + 1)
            dx, dy = columns - at, -(rows - up)[:, np.newaxis]
            cosine, sine = np.cos(of["theta"][y, x]), np.sin(of["theta"][y, x])
            along, across = dx * cosine + dy * sine, dy * cosine - dx * sine
            share = np.exp(-((along / major) ** 2 + (across / minor) ** 2) / 2)
            under = backdrop[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            arrived[y, x] += weight[y, x] * np.tensordot(share / share.sum(), under, 2)
    rho, S = (np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1) for name in ("rho", "S"))
    return S + (rho * arrived) @ crosstalk.T


@pytest.mark.slow
def test_a_recomposite_from_the_exr_alone_is_as_close_to_the_truth(
    objects: Objects, ingest: Callable[..., object]
) -> None:
    scene = glass_ball(48, 36, monitor=(320, 240), rays=16)
    target = io.BytesIO()
    write_capture(
        scene, nested_program((320, 240), bands=((16, 12, 24), (32, 24, 24), (64, 48, 20)), levels=5), target
    )
    ingest("c", target.getvalue())
    task = Task("j", "c", "m", {"method": "lobes"}, Limits(1 << 30, 1 << 26))
    for step in (PREPARE, *range(run(STEPS, objects, task, PREPARE)[1]["tiles"]), FINISH):
        run(STEPS, objects, task, step)
    matte = Matte(objects, "m")
    y, x = np.mgrid[:240, :320] / 320
    backdrop = np.stack([0.5 + 0.4 * np.sin(25 * x + 9 * y), 1 - x, 0.5 + 0.4 * np.sin(19 * y)], axis=-1)
    backdrop = backdrop.astype(np.float32)
    channels, spec = read(partial(layers.everything, matte))
    crosstalk = np.reshape(spec.getattribute("crosstalk"), (3, 3)).astype(float)
    again, own, truth = (
        recomposite(channels, crosstalk, backdrop),
        composite(matte, backdrop),
        scene.truth(backdrop),
    )

    def psnr(picture: NDArray, where: NDArray[np.bool_]) -> float:
        return float(-10 * np.log10(np.mean((picture[..., :3] - truth)[where] ** 2)))

    held = np.min([channels[f"lobe0.weight.{c}"] for c in "RGB"], axis=0) > 0.95
    one = scene.object_mask & held
    assert one.sum() > 0.3 * scene.object_mask.sum()
    assert psnr(again, one) > psnr(own, one) - 1
