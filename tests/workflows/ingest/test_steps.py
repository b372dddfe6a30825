"""Ingest: a capture's files into its stack, value for value, within its memory, and what it refuses."""

import io
import random
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from storage.errors import CaptureError, Corrupt, OverLimit
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.parts import peak
from tests.workflows.ingest.video.camera import Camera, Film, capture, film
from tests.workflows.ingest.video.films import CAMERA, PROGRAM, IngestFilm, program_with
from workflows.images.integer_formats import encode_png
from workflows.ingest import steps, stills
from workflows.jobs import Task
from workflows.untrusted.limits import Limits

Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]
Put = Callable[[str, bytes], None]
Digests = Callable[[str], dict[str, str]]
COMPRESSING = 50 << 20
"""Bytes that compressing a slab takes beside the memory for frames, as services/README.md says."""
HEIGHT, WIDTH = 21, 37


def manifest(patterns: list[int], suffix: str = "png", **more: Any) -> dict[str, Any]:
    """The capture.json of six small patterns."""
    return {
        "format": "envmatte-capture/1",
        "program": {
            "monitor": {"width": 64, "height": 48},
            "parts": [
                {"kind": "constant", "levels": [0, 0.5, 1]},
                {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 3, "seed": 1},
            ],
        },
        "response": "linear",
        "frames": [{"file": f"{n}.{suffix}", "pattern": p} for n, p in enumerate(patterns)],
    } | more


def tiff(pixels: NDArray[Any]) -> bytes:
    target = io.BytesIO()
    kind = "rgb" if pixels.shape[2] == 3 else "minisblack"
    tifffile.imwrite(target, pixels, photometric=kind, compression="zlib")
    return target.getvalue()


def shots(count: int, channels: int, dtype: str) -> NDArray[Any]:
    top = np.iinfo(dtype).max
    return np.random.default_rng(3).integers(0, top, (count, HEIGHT, WIDTH, channels), dtype, endpoint=True)


def archive_of(
    make_zip: Zip, stack: NDArray[Any], patterns: list[int], suffix: str = "png", **more: Any
) -> bytes:
    encode = tiff if suffix == "tif" else encode_png
    files = {f"{n}.{suffix}": encode(frame) for n, frame in enumerate(stack)}
    extra = more.pop("files", {})
    return make_zip(manifest(patterns, suffix, **more), files | extra)


PATTERNS = [4, 0, 1, 5, 0, 2, 3, 1, 4, 0]
"""Several frames of a pattern, in no order."""


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("memory", [1 << 24, 40_000])
def test_stack_holds_the_exact_values(
    make_zip: Zip, ingest: Ingest, suffix: str, dtype: str, channels: int, memory: int
) -> None:
    values = shots(len(PATTERNS), channels, dtype)
    mask = np.random.default_rng(4).random((HEIGHT, WIDTH)) < 0.6
    files = {"mask.png": encode_png((mask * 7).astype(np.uint8)[..., None])}
    stack = ingest(
        "c", archive_of(make_zip, values, PATTERNS, suffix, mask="mask.png", files=files), memory=memory
    )
    assert stack.dtype == dtype
    np.testing.assert_array_equal(stack.read(), values)
    np.testing.assert_array_equal(stack.read_masked()[1], mask)
    assert stack.attributes["patterns"] == PATTERNS
    assert stack.attributes["camera_curve"] == stack.attributes["monitor_curve"] == "linear"
    assert set(stack.attributes["noise"]) == {"read", "shot"}


def test_patterns_that_are_images_are_kept_on_their_grid(make_zip: Zip, ingest: Ingest) -> None:
    grid = np.array([[[0], [255], [51]], [[102], [0], [255]]], np.uint8)
    files = {
        "a.png": encode_png(grid.repeat(8, axis=0).repeat(4, axis=1)),
        "b.png": encode_png(grid.repeat(3, 2)),
    }
    given = manifest([0, 1, 2, 3])
    given["program"]["parts"][0]["levels"] = [0, 1]
    given["program"]["parts"][1] = {"kind": "images", "files": ["a.png", "b.png"]}
    pictures = {f"{n}.png": encode_png(frame) for n, frame in enumerate(shots(4, 1, "uint8"))}
    one, two = ingest("c", make_zip(given, files | pictures)).images()
    np.testing.assert_allclose(one, grid / 255, rtol=1e-6)
    np.testing.assert_allclose(two, grid.repeat(3, 2) / 255, rtol=1e-6)


def test_patterns_that_are_large_images_are_refused(make_zip: Zip, ingest: Ingest) -> None:
    photograph = np.random.default_rng(0).integers(0, 255, (60, 60, 3), np.uint8)
    names = [f"{n}.jpg.png" for n in range(9)]
    given = manifest(list(range(12)))
    given["program"]["parts"][1] = {"kind": "images", "files": names}
    pictures = {f"{n}.png": encode_png(frame) for n, frame in enumerate(shots(12, 1, "uint8"))}
    data = make_zip(given, pictures | dict.fromkeys(names, encode_png(photograph)))
    with pytest.raises(CaptureError, match="image files of patterns") as caught:
        ingest("c", data, memory=400_000)
    assert caught.value.fields == {"entry": names[4], "limit": 200_000}


def test_images_of_patterns_are_decoded_once_and_within_a_limit(
    make_zip: Zip, ingest: Ingest, monkeypatch: pytest.MonkeyPatch
) -> None:
    flat = encode_png(np.full((60, 60, 3), 9, np.uint8))
    read, decoded = stills.read_integers, []
    monkeypatch.setattr(stills, "read_integers", lambda *given: decoded.append(given[2]) or read(*given))
    pictures = {f"{n}.png": encode_png(frame) for n, frame in enumerate(shots(12, 1, "uint8"))}

    def given(names: list[str]) -> bytes:
        made = manifest(list(range(12)))
        made["program"]["parts"][1] = {"kind": "images", "files": names}
        return make_zip(made, pictures | dict.fromkeys(names, flat), zipfile.ZIP_DEFLATED)

    assert len(ingest("c", given(["a.png", "b.png", *["a.png"] * 7])).images()) == 9
    assert decoded == ["a.png", "b.png"]
    unpacked = 5 * 60 * 60 * 3
    with pytest.raises(CaptureError, match="take more than 54000 bytes together") as caught:
        ingest("c", given([f"{n}.jpg" for n in range(9)]), unpacked=unpacked)
    assert caught.value.fields == {"entry": "5.jpg", "limit": unpacked}


def test_slabs_in_any_order_and_again_are_the_same_bytes(
    make_zip: Zip, ingest: Ingest, digests: Digests
) -> None:
    data = archive_of(make_zip, shots(len(PATTERNS), 3, "uint16"), PATTERNS)
    memory = 6 * HEIGHT * WIDTH * 3 * 2  # slabs of three frames
    ingest("c", data, memory=memory)
    plain = digests("captures/c")

    def shuffled(slabs: range) -> Iterator[int]:
        assert len(slabs) == 4
        order = [*slabs, *slabs]
        random.Random(1).shuffle(order)
        yield from order

    ingest("c", data, memory=memory, order=shuffled)
    assert digests("captures/c") == plain


def test_missing_slab_is_corrupt(make_zip: Zip, ingest: Ingest) -> None:
    data = archive_of(make_zip, shots(len(PATTERNS), 3, "uint16"), PATTERNS)
    with pytest.raises(Corrupt, match=r"c/thumbnails/c/0/0/0 is missing"):
        ingest("c", data, memory=6 * HEIGHT * WIDTH * 6, order=lambda slabs: iter(slabs[1:]))


def test_frames_that_unpack_to_too_much_are_refused(make_zip: Zip, ingest: Ingest) -> None:
    size = 6 * HEIGHT * WIDTH * 3
    flat = encode_png(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    archive = make_zip(manifest([*range(6)]), {f"{n}.png": flat for n in range(6)})
    with pytest.raises(CaptureError, match=f"6 frames of 37 x 21 pixels take {size} bytes") as caught:
        ingest("c", archive, unpacked=size - 1)
    assert caught.value.fields == {"entry": "capture.json", "field": "frames", "limit": size - 1}


def test_files_that_interrupted_workers_left_are_removed(make_zip: Zip, ingest: Ingest, folder: Path) -> None:
    def leave(tiles: range) -> Iterator[int]:
        (folder / "captures/c/left#1").write_bytes(b"half a chunk")
        return iter(tiles)

    frames = {f"{n}.png": encode_png(np.full((HEIGHT, WIDTH, 3), 40 * n, np.uint8)) for n in range(6)}
    ingest("c", make_zip(manifest([*range(6)]), frames), order=leave)
    assert not (folder / "captures/c/left#1").exists()


@pytest.mark.parametrize(
    "odd",
    [
        np.zeros((HEIGHT + 1, WIDTH, 3), np.uint8),
        np.zeros((WIDTH, HEIGHT, 3), np.uint8),
        np.zeros((HEIGHT, WIDTH, 3), np.uint16),
        np.zeros((HEIGHT, WIDTH, 1), np.uint8),
    ],
)
def test_a_frame_unlike_the_first_is_refused(make_zip: Zip, ingest: Ingest, odd: NDArray[Any]) -> None:
    data = archive_of(make_zip, shots(5, 3, "uint8"), [0, 1, 2, 3, 4, 5], files={"5.png": encode_png(odd)})
    with pytest.raises(CaptureError, match="one size and kind") as caught:
        ingest("c", data)
    assert caught.value.fields == {"entry": "5.png"}


@pytest.mark.parametrize("at", [0, 3])
@pytest.mark.parametrize("data", [b"no image", encode_png(shots(1, 3, "uint8")[0])[:-30], b""])
def test_frame_that_cannot_be_decoded_is_refused(make_zip: Zip, ingest: Ingest, at: int, data: bytes) -> None:
    given = archive_of(make_zip, shots(6, 3, "uint8"), [0, 1, 2, 3, 4, 5], files={f"{at}.png": data})
    with pytest.raises(CaptureError, match=rf"^{at}\.png: ") as caught:
        ingest("c", given)
    assert caught.value.fields["entry"] == f"{at}.png"


def test_a_mask_of_another_size_is_refused(make_zip: Zip, ingest: Ingest) -> None:
    files = {"mask.png": encode_png(np.zeros((WIDTH, HEIGHT, 1), np.uint8))}
    data = archive_of(make_zip, shots(6, 3, "uint8"), list(range(6)), mask="mask.png", files=files)
    with pytest.raises(CaptureError, match="the frames are 37 x 21") as caught:
        ingest("c", data)
    assert caught.value.fields == {"entry": "mask.png"}


@pytest.mark.parametrize("channels", [1, 4])
def test_a_mask_of_nothing_is_refused(make_zip: Zip, ingest: Ingest, channels: int) -> None:
    """Also a black cut-out, whose shape is in its transparency."""
    cut_out = np.zeros((HEIGHT, WIDTH, channels), np.uint8)
    cut_out[5:, 5:, 3:] = 255
    target = io.BytesIO()
    Image.fromarray(cut_out.squeeze()).save(target, "PNG")
    files = {"mask.png": target.getvalue()}
    data = archive_of(make_zip, shots(6, 3, "uint8"), list(range(6)), mask="mask.png", files=files)
    with pytest.raises(CaptureError, match="black everywhere") as caught:
        ingest("c", data)
    assert caught.value.fields == {"entry": "mask.png"}


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_a_frame_larger_than_a_quarter_of_the_memory_is_refused(
    make_zip: Zip, ingest: Ingest, dtype: str
) -> None:
    flat = np.full((6, 100, 100, 3), 9, dtype)
    size = flat[0].nbytes
    data = archive_of(make_zip, flat, list(range(6)))
    ingest("c", data, memory=4 * size)
    with pytest.raises(CaptureError, match="100 x 100 pixels") as caught:
        ingest("c", data, memory=4 * (size - 1))
    assert caught.value.fields == {"entry": "0.png", "limit": size - 1}


@pytest.mark.slow
def test_stack_over_the_limit_is_refused(make_zip: Zip, ingest: Ingest) -> None:
    # One small file, named by a hundred thousand frames.
    flat = encode_png(np.full((100, 100, 3), 9, np.uint8))
    given = manifest([n % 6 for n in range(100_000)])
    for frame in given["frames"]:
        frame["file"] = "0.png"
    with pytest.raises(
        CaptureError, match="100000 frames of 100 x 100 pixels take 3000000000 bytes"
    ) as caught:
        ingest("c", make_zip(given, {"0.png": flat}, zipfile.ZIP_DEFLATED), unpacked=1 << 31)
    assert caught.value.fields == {"entry": "capture.json", "field": "frames", "limit": 1 << 31}


def test_frames_of_more_pixels_than_are_allowed_are_refused(
    make_zip: Zip, put: Put, objects: Objects
) -> None:
    put("c", archive_of(make_zip, shots(6, 3, "uint8"), list(range(6))))
    most = HEIGHT * WIDTH
    task = Task("j", "c", "", {}, Limits(1 << 30, 1 << 26, pixels=most))
    assert steps.prepare(objects, task)["tiles"] >= 1
    task = replace(task, limits=Limits(1 << 30, 1 << 26, pixels=most - 1))
    with pytest.raises(OverLimit, match=f"a frame may have {most - 1} pixels") as caught:
        steps.prepare(objects, task)
    assert {"name": "capture_pixels", "limit": most - 1, "value": most}.items() <= caught.value.fields.items()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the resident peak is read from Linux's /proc")
def test_a_stack_larger_than_the_memory_is_ingested_within_it(
    make_zip: Zip, put: Put, objects: Objects
) -> None:
    memory, count = 128 << 20, 100
    patterns = [n % 6 for n in range(count)]
    put("small", archive_of(make_zip, shots(6, 3, "uint8"), list(range(6))))
    y, x = np.mgrid[:980, :1440]
    smooth = np.stack([x // 4, y // 3, (x + y) // 8], axis=2).astype(np.uint8)
    files = {f"{n}.png": encode_png(smooth + np.uint8(n % 6)) for n in range(6)}
    given = manifest(patterns)
    for n, frame in enumerate(given["frames"]):
        frame["file"] = f"{n % 6}.png"
    put("large", make_zip(given, files))
    stack = count * smooth.nbytes
    assert stack > 3 * memory
    tiles, grown = peak.of_large_after_small(objects, memory)
    assert tiles > 4
    assert memory // 3 < grown <= memory + COMPRESSING
    assert Stack(objects, "large").frames == count


def turned_png(orientation: int, pixels: NDArray[np.uint8]) -> bytes:
    exif = Image.Exif()
    exif[274] = orientation
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, "PNG", exif=exif)
    return target.getvalue()


def test_all_frames_get_the_orientation_of_the_first(make_zip: Zip, ingest: Ingest) -> None:
    """A camera that looks down on a table may write another orientation from frame to frame."""
    frames = np.random.default_rng(5).integers(0, 256, (6, 20, 30, 3), np.uint8)
    files = {f"{n}.png": turned_png(turn, frames[n]) for n, turn in enumerate((6, 6, 1, 3, 6, 8))}
    mask = np.zeros((30, 20, 1), np.uint8)  # drawn over a frame as it is shown
    mask[5:25, 5:15] = 255
    stack = ingest(
        "c",
        make_zip(manifest(list(range(6)), mask="mask.png"), files | {"mask.png": encode_png(mask)}),
    )
    assert (stack.width, stack.height) == (20, 30)
    np.testing.assert_array_equal(stack.read(), np.rot90(frames, 3, axes=(1, 2)))
    assert stack.attributes["orientation"] == 6


def test_a_mask_of_frames_before_rotation_is_refused(make_zip: Zip, ingest: Ingest) -> None:
    shot = np.zeros((20, 30, 3), np.uint8)
    files = {f"{n}.png": turned_png(6, shot) for n in range(6)}
    with pytest.raises(CaptureError, match="turned upright as the first of them says"):
        ingest(
            "c",
            make_zip(
                manifest(list(range(6)), mask="mask.png"),
                files | {"mask.png": encode_png(shot)},
            ),
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "pack", [zipfile.ZIP_DEFLATED, pytest.param(zipfile.ZIP_STORED, marks=pytest.mark.exhaustive)]
)
def test_slabs_of_a_video_do_not_change_the_bytes(
    ingest_film: IngestFilm, digests: Digests, light: list[np.ndarray], pack: int
) -> None:
    made = film(light, Camera(fps=24, hold=0.2, readout=0.005, options={"g": "12", "bf": "3"}))
    whole, stored = ingest_film(made.data, 5, pack=pack).read(), []
    assert len(whole) == PROGRAM.count
    for order in (iter, reversed):
        memory = len(made.shown) * 24 * 32 * 3 * 4  # what sorting takes
        assert memory // (2 * whole[0].nbytes) < len(whole)  # several slabs
        few = ingest_film(made.data, 5, pack=pack, memory=memory, order=order)
        np.testing.assert_array_equal(few.read(), whole)
        stored.append(digests("captures/c"))
    assert stored[0] == stored[1]


def test_film_of_too_many_patterns_is_refused(ingest_film: IngestFilm, filmed: Film) -> None:
    with pytest.raises(CaptureError, match="more than the 2000") as caught:
        ingest_film(filmed.data, program=program_with(count=700))
    assert caught.value.fields == {"entry": "clip.mp4", "limit": 2000}


@pytest.mark.exhaustive
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the resident peak is read from Linux's /proc")
def test_long_video_is_ingested_within_its_memory(
    make_zip: Zip, put: Callable[[str, bytes], None], objects: Objects, light: list[np.ndarray]
) -> None:
    memory, rate = 64 << 20, 1 / CAMERA.hold
    coarse = [np.kron(picture, np.ones((4, 4, 1), np.float32)) for picture in light]
    for name, camera in {
        "small": Camera(options={"g": "20"}),
        "large": Camera(fps=90, options={"g": "20"}),
    }.items():
        made = film(coarse, camera)
        put(name, make_zip(*capture(PROGRAM, made.data, rate)))
    decoded = len(made.shown) * coarse[0].size
    assert decoded > 4 * memory
    _, grown = peak.of_large_after_small(objects, memory)
    assert grown <= memory // 2  # eight times less than the frames, decoded
