"""Frames of float values and camera RAW, and several exposures, from a capture archive into the stack."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import OpenEXR
import pytest
import tifffile
from numpy.typing import NDArray

from storage.errors import CaptureError
from storage.layout.captures import Stack
from tests.parts.inputs.heics import heic
from workflows.images import hdr
from workflows.images.integer_formats import encode_jpeg, encode_png
from workflows.images.tone_curves import BLACK, table
from workflows.ingest.report.report import report

Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]
Dng = Callable[..., bytes]
HEIGHT, WIDTH = 20, 36
LEVELS = [0, 0.5, 1]


def manifest(suffix: str, frames: int = 6, **more: Any) -> dict[str, Any]:
    return {
        "format": "envmatte-capture/1",
        "program": {
            "monitor": {"width": 64, "height": 48},
            "parts": [
                {"kind": "constant", "levels": LEVELS},
                {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 3, "seed": 1},
            ],
        },
        "frames": [{"file": f"{n}.{suffix}", "pattern": n % 6} for n in range(frames)],
    } | more


def light(peak: float, noise: float = 0.002) -> NDArray[np.float32]:
    """Six frames: three constants, and what are three patterns."""
    rng = np.random.default_rng(2)
    rho = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))
    share = [*LEVELS, *rng.uniform(0, 1, 3)]
    frames = peak * np.stack([s * rho for s in share])
    return (frames + rng.normal(0, noise * peak, frames.shape)).astype(np.float32)


def exr(pixels: NDArray[Any]) -> bytes:
    target = io.BytesIO()
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": pixels}).write(target)
    return target.getvalue()


def float_tiff(pixels: NDArray[Any]) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, photometric="rgb")
    return target.getvalue()


def decoded(stack: Stack) -> NDArray[Any]:
    storage = stack.attributes["storage"]
    look_up = table(stack.attributes["camera_curve"], stack.dtype, storage["black"])
    return look_up[stack.read()] * storage["full"]


@pytest.mark.parametrize(("suffix", "encode"), [("exr", exr), ("tif", float_tiff)])
@pytest.mark.parametrize("peak", [0.001, 1.0, 5000.0])
def test_float_frames_are_stored_in_units_of_the_white_frame(
    make_zip: Zip, ingest: Ingest, suffix: str, encode: Callable[..., bytes], peak: float
) -> None:
    frames = light(peak)
    stack = ingest(
        "c", make_zip(manifest(suffix), {f"{n}.{suffix}": encode(f) for n, f in enumerate(frames)})
    )
    assert stack.dtype == np.uint16
    assert stack.attributes["camera_curve"] == "linear"
    # 1.05 times the largest of white, over 61439 steps; black's noise is on both sides of zero
    assert stack.attributes["storage"]["full"] == pytest.approx(1.05 * frames[2].max())
    np.testing.assert_allclose(decoded(stack), frames, atol=0.6 * 1.05 * frames[2].max() / (65535 - BLACK))
    assert (decoded(stack) < 0).any()
    assert stack.attributes["assumed_curves"] == []


def test_white_that_was_exposed_longest_is_full_scale(make_zip: Zip, ingest: Ingest) -> None:
    frames, given = light(1.0), manifest("exr")
    given["program"]["parts"][0]["levels"] = [1, 0, 0.5]
    frames[:3] = frames[[2, 0, 1]]
    given["frames"].append({"file": "6.exr", "pattern": 0, "exposure": 4})
    files = {f"{n}.exr": exr(f) for n, f in enumerate([*frames, 4 * frames[0]])}
    stack = ingest("c", make_zip(given, files))
    assert stack.attributes["storage"]["full"] == pytest.approx(1.05 * 4 * frames[0].max())


def test_nan_and_values_out_of_range_are_clipped(make_zip: Zip, ingest: Ingest) -> None:
    frames = light(1.0)
    frames[2, 5, 5] = 1e6  # a glint does not set the scale
    frames[4, 0, 0] = np.inf, np.nan, -np.inf
    frames[4, 0, 1] = 1e6, -1e6, 0
    stack = ingest("c", make_zip(manifest("exr"), {f"{n}.exr": exr(f) for n, f in enumerate(frames)}))
    assert stack.attributes["storage"]["full"] < 5
    codes = stack.read()[4, 0, :2].tolist()
    assert codes == [[65535, 0, 0], [65535, 0, BLACK]]


def test_raw_frames_are_stored_in_units_of_the_white_level(
    make_zip: Zip, ingest: Ingest, make_dng: Dng
) -> None:
    counts = np.random.default_rng(5).integers(200, 3900, (6, 2 * HEIGHT, 2 * WIDTH), np.uint16)
    counts[4, 0, 0] = 4095
    stack = ingest(
        "c", make_zip(manifest("DNG"), {f"{n}.DNG": make_dng(c, 256, 4095) for n, c in enumerate(counts)})
    )
    assert stack.read().shape == (6, HEIGHT, WIDTH, 3)
    assert stack.attributes["storage"] == {"black": BLACK, "full": 1.0, "bounded": True}
    assert stack.read()[4, 0, 0, 0] == 65535
    red = (counts[:, ::2, ::2].astype(np.float32) - 256) / (4095 - 256)
    got = decoded(stack)[..., 0]
    got[4, 0, 0] = red[4, 0, 0]
    np.testing.assert_allclose(got, red, atol=1e-5)


def test_floats_have_no_curve(make_zip: Zip, ingest: Ingest) -> None:
    files = {f"{n}.exr": exr(f) for n, f in enumerate(light(1.0))}
    with pytest.raises(CaptureError, match="hold linear light") as caught:
        ingest("c", make_zip(manifest("exr", response="srgb"), files))
    assert caught.value.fields == {"entry": "capture.json", "field": "response"}


def test_a_white_frame_without_light_is_refused(make_zip: Zip, ingest: Ingest) -> None:
    files = {f"{n}.exr": exr(f * (n != 2)) for n, f in enumerate(light(1.0))}
    with pytest.raises(CaptureError, match="holds no light") as caught:
        ingest("c", make_zip(manifest("exr"), files))
    assert caught.value.fields == {"entry": "2.exr"}


def test_a_white_frame_of_infinite_light_is_called_clipped(make_zip: Zip, ingest: Ingest) -> None:
    files = {f"{n}.exr": exr(np.full_like(f, np.inf) if n == 2 else f) for n, f in enumerate(light(1.0))}
    with pytest.raises(CaptureError, match="is clipped everywhere: expose shorter") as caught:
        ingest("c", make_zip(manifest("exr"), files))
    assert caught.value.fields == {"entry": "2.exr"}


def test_integers_among_floats_are_refused(make_zip: Zip, ingest: Ingest) -> None:
    files = {f"{n}.exr": exr(f) for n, f in enumerate(light(1.0))}
    files["4.exr"] = encode_png(np.ones((HEIGHT, WIDTH, 3), np.uint16))
    with pytest.raises(CaptureError, match="one size and kind") as caught:
        ingest("c", make_zip(manifest("exr"), files))
    assert caught.value.fields == {"entry": "4.exr"}


def test_raw_of_a_camera_that_is_not_known_is_refused(make_zip: Zip, ingest: Ingest) -> None:
    files = {f"{n}.nef": bytes(9000) for n in range(6)}
    with pytest.raises(CaptureError, match=r"^0\.nef: this camera's RAW format is not supported") as caught:
        ingest("c", make_zip(manifest("nef"), files))
    assert caught.value.fields == {"entry": "0.nef"}


def test_heic_frames_are_turned_as_the_first(make_zip: Zip, ingest: Ingest) -> None:
    codes = np.random.default_rng(5).integers(0, 256, (6, 2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
    turns = [6, 6, 1, 3, 6, 6]  # a camera that looks down detects its orientation at random
    files = {f"{n}.HEIC": heic(c, turn) for n, (c, turn) in enumerate(zip(codes, turns, strict=True))}
    stack = ingest("c", make_zip(manifest("HEIC"), files))
    np.testing.assert_array_equal(stack.read(), np.rot90(codes, -1, axes=(1, 2)))


@pytest.mark.parametrize(
    ("colour", "chroma", "warned"), [("rgb", 420, True), ("rgb", 444, False), ("grey", 420, False)]
)
def test_patterns_in_colour_are_warned_of_where_frames_halve_it(
    colour: str, chroma: int, warned: bool, make_zip: Zip, ingest: Ingest
) -> None:
    made = manifest("heic")
    made["program"]["parts"][1]["colour"] = colour
    frames = (255 * light(0.9)).clip(0, 255).astype(np.uint8)
    files = {f"{n}.heic": heic(f, chroma=chroma, matrix_coefficients=1) for n, f in enumerate(frames)}
    stack = ingest("c", make_zip(made, files))
    costs = {finding.name: finding.cost for finding in report(stack.attributes, stack.frames).findings}
    assert ("coloured_patterns" in costs) == warned
    assert not warned or (costs["coloured_patterns"] or 0) > 0


def test_raw_is_recognised_whatever_its_name(make_zip: Zip, ingest: Ingest, make_dng: Dng) -> None:
    counts = np.random.default_rng(5).integers(200, 3900, (6, 2 * HEIGHT, 2 * WIDTH), np.uint16)
    thumbnail = np.zeros((8, 12, 3), np.uint8)
    files = {f"{n}.tif": make_dng(c, 256, 4095, thumbnail=thumbnail) for n, c in enumerate(counts)}
    stack = ingest("c", make_zip(manifest("tif"), files))
    assert stack.read().shape == (6, HEIGHT, WIDTH, 3)
    assert stack.attributes["storage"] == {"black": BLACK, "full": 1.0, "bounded": True}


def test_a_jpeg_with_the_name_of_raw_is_refused_with_a_remedy(make_zip: Zip, ingest: Ingest) -> None:
    jpeg = encode_jpeg(np.ones((HEIGHT, WIDTH, 3), np.uint8), 90)
    with pytest.raises(CaptureError, match=r"^0\.nef: this is a JPEG .* rename it to \.jpg"):
        ingest("c", make_zip(manifest("nef"), {f"{n}.nef": jpeg for n in range(6)}))


def test_full_scale_of_an_unfinished_capture_is_that_of_the_brightest_frame_there_is(
    make_zip: Zip, ingest: Ingest
) -> None:
    frames, given = light(1.0), manifest("exr", unfinished=True)
    given["frames"] = [frame for frame in given["frames"] if frame["pattern"] != 2]
    files = {f"{n}.exr": exr(f) for n, f in enumerate(frames) if n != 2}
    stack = ingest("c", make_zip(given, files))
    assert stack.attributes["storage"]["full"] == pytest.approx(1.05 * frames[1].max())


@pytest.mark.parametrize("white", [0.5, 2.5])
def test_monitor_brighter_than_the_white_of_hdr_is_not_clipped(
    make_zip: Zip, ingest: Ingest, white: float
) -> None:
    frames = light(1.0, noise=0)
    codes = np.searchsorted(hdr.light_of_hdr(hdr.HLG), white * frames) // 64
    stated = {"color_primaries": hdr.BT_2020, "transfer_characteristics": hdr.HLG}
    files = {f"{n}.heic": heic(c.astype(np.uint16), **stated) for n, c in enumerate(codes)}
    stack = ingest("c", make_zip(manifest("heic", response="srgb"), files))
    srgb = np.clip(white * frames @ hdr.TO_SRGB.T, 0, None)
    full = stack.attributes["storage"]["full"]
    assert full == pytest.approx(max(1.1 * np.percentile(srgb[2], 99.9), 1), rel=0.02)
    np.testing.assert_allclose(decoded(stack), srgb, atol=0.01 * white)
