"""The Python client against a real service."""

from pathlib import Path

import numpy as np
import pytest

from services.client import Client, NotFound
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, png
from workflows.images import float_formats, integer_formats
from workflows.simulation import glass_ball


@pytest.mark.slow
def test_from_a_file_to_an_array(service: Service, capture_archive: Path) -> None:
    sent_so_far: list[tuple[int, int]] = []
    with Client(service.url) as client:
        capture = client.upload(
            str(capture_archive), name="mine", progress=lambda sent, size: sent_so_far.append((sent, size))
        )
        assert sent_so_far[-1] == (capture_archive.stat().st_size,) * 2
        assert client.wait(capture).kind == "ingest"
        capture = client.capture(capture)
        assert (capture.name, capture.state, capture.width, capture.height) == (
            "mine",
            "ready",
            WIDTH,
            HEIGHT,
        )
        job = client.wait(client.recover(capture, quality="fast"))
        assert (job.state, job.options["quality"], job.capture) == ("succeeded", "fast", capture.id)
        matte = client.matte(job)
        assert (matte.id, matte.state, matte.width, matte.height) == (job.matte, "ready", WIDTH, HEIGHT)
        composite = client.composite(matte, glass_ball.backdrop(64, 48))
        assert (composite.shape, composite.dtype) == ((HEIGHT, WIDTH, 3), np.float32)
        client.delete(job)
        client.delete(matte)
        client.delete(capture)
        for gone in (lambda: client.job(job), lambda: client.matte(matte), lambda: client.capture(capture)):
            with pytest.raises(NotFound):
                gone()


def test_array_is_linear_light(service: Service, matte: str, tmp_path: Path) -> None:
    client, light = service.client, np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)
    composite = client.composite(matte, light)
    sent = client.composite(matte, float_formats.encode_exr("RGB", light), kind="image/x-exr")
    np.testing.assert_array_equal(composite, float_formats.decode(sent, memory=1 << 24))
    grey = client.composite(matte, light[..., 0], size=48)
    assert grey.shape == (36, 48, 3)
    (tmp_path / "backdrop.png").write_bytes(png(light, "srgb", np.uint8))
    picture = client.composite(matte, tmp_path / "backdrop.png", kind="image/png")
    assert integer_formats.decode(picture, memory=1 << 24).shape == (HEIGHT, WIDTH, 3)


def test_layers_are_arrays(service: Service, matte: str) -> None:
    layers = service.client.matte(matte).layers
    assert {name: layer.shape for name, layer in layers.items()} == {
        "S": (HEIGHT, WIDTH, 3),
        "rho": (HEIGHT, WIDTH, 3),
        "alpha": (HEIGHT, WIDTH),
        "confidence": (HEIGHT, WIDTH),
    }
    expected = float_formats.decode(service.client.layer(matte, "S.exr"), memory=1 << 24)
    np.testing.assert_array_equal(layers["S"], expected)
    with pytest.raises(KeyError, match="confidence"):
        layers["T"]
