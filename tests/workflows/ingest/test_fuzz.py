"""Whatever bytes come: a bundle, a capture.json, every kind of frame is read or refused, and no other error leaves."""

import copy
import io
import json
import zipfile
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import OpenEXR
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from storage.errors import CaptureError
from workflows.images import encode_png
from workflows.ingest import stills
from workflows.ingest.bundle import Bundle, Limits

LIMITS = Limits(unpacked=1 << 22, memory=1 << 22)
bounded = settings(
    max_examples=120,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
PIXELS = np.random.default_rng(9).integers(0, 255, (24, 36, 3), np.uint8)
RECORD: dict[str, Any] = {
    "format": "envmatte-capture/1",
    "name": "ball",
    "program": {
        "monitor": {"width": 64, "height": 48, "response": {"gamma": 2.2}},
        "parts": [
            {"kind": "constant", "levels": [0, 0.5, 1]},
            {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 2, "seed": 1, "offset": True},
            {"kind": "stripes", "axis": "x", "count": 2},
            {"kind": "images", "files": ["a.png"]},
        ],
    },
    "response": "unknown",
    "frames": [{"file": f"{n}.png", "pattern": n, "exposure": 0.5} for n in range(8)],
    "mask": "a.png",
}


def packed(record: bytes) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("capture.json", record)
        for name in ("a.png", *(f"{n}.png" for n in range(8))):
            archive.writestr(name, name.encode() * 9)
    return target.getvalue()


WHOLE = packed(json.dumps(RECORD).encode())


def saved(kind: str) -> bytes:
    target = io.BytesIO()
    Image.fromarray(PIXELS).save(target, kind)
    return target.getvalue()


def tiff(pixels: NDArray[Any], **options: Any) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, photometric="rgb", **options)
    return target.getvalue()


def exr(pack: Any, tile: int = 0) -> bytes:
    header = {"compression": pack, "type": OpenEXR.tiledimage if tile else OpenEXR.scanlineimage}
    if tile:
        header["tiles"] = OpenEXR.TileDescription()
        header["tiles"].xSize = header["tiles"].ySize = tile
    target = io.BytesIO()
    OpenEXR.File(header, {"RGB": (PIXELS / 255).astype(np.float32)}).write(target)
    return target.getvalue()


FRAMES = {
    "a.png": encode_png(PIXELS),
    "b.png": encode_png(PIXELS.astype(np.uint16) * 257),
    "a.jpg": saved("JPEG"),
    "a.tif": tiff(PIXELS, compression="lzw", rowsperstrip=5),
    "float.tif": tiff((PIXELS / 255).astype(np.float32), compression="zlib"),
    "a.exr": exr(OpenEXR.ZIP_COMPRESSION),
    "b.exr": exr(OpenEXR.DWAA_COMPRESSION),
    "c.exr": exr(OpenEXR.PIZ_COMPRESSION, 16),
}
Got = TypeVar("Got")
NUMBERS = st.sampled_from([0, 1, 2, 0x7F, 0x80, 0xFF]) | st.integers(0, 255)


def tried(call: Callable[[], Got]) -> Got | CaptureError:
    """What a call returns, or the refusal; any other error fails the test."""
    try:
        return call()
    except CaptureError as error:
        return error


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file with some bytes changed, headers more often than the rest, and perhaps cut, or a part of it doubled."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 6))):
        reach = draw(st.sampled_from([min(64, len(data)), min(600, len(data)), len(data)]))
        data[draw(st.integers(0, reach - 1))] = draw(NUMBERS)
    change = draw(st.sampled_from(["none", "none", "cut", "doubled"]))
    at = draw(st.integers(0, len(data)))
    if change == "cut":
        del data[at:]
    elif change == "doubled":
        data[at:at] = data[: draw(st.integers(0, len(data)))]
    return bytes(data)


@pytest.mark.parametrize("name", [*FRAMES, "a.dng"])
@bounded
@given(choices=st.data())
def test_a_damaged_frame_is_read_or_refused(
    make_dng: Callable[..., bytes], name: str, choices: st.DataObject
) -> None:
    whole = FRAMES.get(name) or make_dng(PIXELS[:, :, 0].astype(np.uint16) * 16, 100, 4095)
    data = choices.draw(damaged(whole))
    target = io.BytesIO()
    frames = [{"file": name, "pattern": n} for n in range(8)]
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("capture.json", json.dumps(RECORD | {"frames": frames, "mask": None}))
        archive.writestr(name, data)
        if name != "a.png":
            archive.writestr("a.png", b"")
    bundle = Bundle(target, LIMITS)
    got = tried(lambda: stills.read(bundle, name, LIMITS))
    if isinstance(got, CaptureError):
        assert got.fields["entry"] == name
        return
    assert got.dtype in (np.uint8, np.uint16, np.float32)
    assert got.ndim == 3
    assert got.shape[2] in (1, 3)
    assert 0 < got.nbytes <= LIMITS.image


@bounded
@given(damaged(WHOLE))
def test_a_damaged_archive_is_read_or_refused(data: bytes) -> None:
    bundle = tried(lambda: Bundle(io.BytesIO(data), LIMITS))
    if isinstance(bundle, Bundle):
        for frame in bundle.manifest.frames:
            tried(lambda name=frame.file: bundle.read(name))


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.sampled_from([0, 1, 2**31, 2**63, 1e308, -1, 16384, 100_000])
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["linear", "constant", "bernoulli", "images", "../a", "a.png", "/", "\0"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to everything in a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [way, *(place for key, inner in inside for place in places(inner, (*way, key)))]


@bounded
@given(st.lists(st.tuples(st.sampled_from(places(RECORD)[1:]), VALUES), min_size=1, max_size=3))
def test_a_capture_json_with_other_values_is_read_or_refused(
    changes: list[tuple[tuple[Any, ...], Any]],
) -> None:
    record = copy.deepcopy(RECORD)
    for way, value in changes:
        inner: Any = record
        try:
            for key in way[:-1]:
                inner = inner[key]
            inner[way[-1]] = value
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took it away
    bundle = tried(lambda: Bundle(io.BytesIO(packed(json.dumps(record).encode())), LIMITS))
    if isinstance(bundle, Bundle):
        program = bundle.manifest.program
        assert program.count >= len(program.constants[0]) > 1
    else:
        assert bundle.fields["entry"]


@bounded
@given(st.binary(max_size=300) | damaged(json.dumps(RECORD).encode()))
def test_a_capture_json_of_any_bytes_is_read_or_refused(text: bytes) -> None:
    got = tried(lambda: Bundle(io.BytesIO(packed(text)), LIMITS))
    assert isinstance(got, Bundle) or got.fields["entry"]
