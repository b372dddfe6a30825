"""The EXR of lookups, read by another library."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import CROSSTALK, draw, few_nodes, read_channels
from workflows.composite import composite
from workflows.composite.live.nodes.exr import write_lookups


@pytest.fixture
def written(objects: Objects, tmp_path: Path) -> Path:
    path = tmp_path / "lookups.exr"
    with path.open("wb") as file:
        write_lookups(few_nodes(objects, 3), file, 4)
    return path


def test_the_header_says_what_the_light_is(written: Path) -> None:
    channels, spec = read_channels(written)
    assert set(channels) == {
        *"RGBA",
        *(f"{name}.{c}" for name in ("S", "rho") for c in "RGB"),
        *(f"{name}{k}.{c}" for name in ("lookup", "weight") for k in range(4) for c in "RGB"),
    }
    types = dict(zip(spec.channelnames, spec.channelformats, strict=True))
    assert types["lookup3.B"] == oiio.FLOAT
    assert types["weight0.R"] == types["S.R"] == oiio.HALF
    np.testing.assert_allclose(
        spec.getattribute("chromaticities"), (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329), rtol=1e-6
    )
    np.testing.assert_allclose(np.reshape(spec.getattribute("crosstalk"), (3, 3)), CROSSTALK, rtol=1e-6)
    assert tuple(spec.getattribute("cells")) == (75, 37)
    assert tuple(spec.getattribute("monitor")) == (150, 74)


def test_it_draws_the_composite_where_lookups_suffice(objects: Objects, tmp_path: Path) -> None:
    matte, path = few_nodes(objects, 3), tmp_path / "lookups.exr"
    backdrop = np.random.default_rng(1).random((74, 150, 3), np.float32)
    for lookups in (3, 4):
        with path.open("wb") as file:
            write_lookups(matte, file, lookups)
        expected = composite(matte, backdrop)
        np.testing.assert_allclose(draw(path, backdrop), expected[..., :3], atol=1e-3)  # half floats
    with path.open("wb") as file:
        write_lookups(matte, file, 1)
    assert np.abs(draw(path, backdrop) - expected[..., :3]).max() > 0.1


def test_it_shows_the_glass_in_front_of_white(objects: Objects, tmp_path: Path) -> None:
    matte, path = few_nodes(objects, 3), tmp_path / "lookups.exr"
    with path.open("wb") as file:
        write_lookups(matte, file, 3)
    channels, _ = read_channels(path)
    white = composite(matte, np.ones((1, 1, 3), np.float32))
    np.testing.assert_allclose(np.stack([channels[c] for c in "RGBA"], axis=-1), white, atol=2e-3)
