"""Pictures decoded in child processes: the same pixels, and children that die, hang or use memory."""

import contextlib
import io
from collections.abc import Callable, Iterator
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor

import imagecodecs
import numpy as np
import psutil
import pytest
import tifffile
from PIL import Image

from services.decoding.pool import Decoders
from storage.errors import ImageError, Unavailable
from tests.parts.inputs.dngs import dng
from tests.parts.inputs.heics import heic
from tests.parts.processes import alive
from tests.parts.waiting import until
from workflows.images import decode, float_formats, integer_formats
from workflows.untrusted import decoder
from workflows.untrusted.decoder_process import NAME

MEMORY = 1 << 24
PIXELS = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)


def children() -> list[psutil.Process]:
    """The decoders that this process has started; services of other tests have their own below it."""
    found = []
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.NoSuchProcess):
            found += child.children()
    return [child for child in alive(found) if child.name() == NAME]


@pytest.fixture
def decoders() -> Iterator[Decoders]:
    decoders = Decoders(MEMORY)
    yield decoders
    decoders.close()
    assert not children()


def saved(kind: str, pixels: np.ndarray = PIXELS, **options: object) -> bytes:
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, **options)
    return target.getvalue()


def tiff(pixels: np.ndarray, **options: object) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, photometric="rgb", **options)
    return target.getvalue()


PNG = integer_formats.encode_png(PIXELS)


PICTURES = {
    "PNG": PNG,
    "PNG, 16 bits": integer_formats.encode_png(PIXELS.astype(np.uint16) * 257),
    "PNG, alpha": integer_formats.encode_png(np.dstack([PIXELS, PIXELS[..., :1]])),
    "PNG, gray": integer_formats.encode_png(PIXELS[..., :1]),
    "JPEG": saved("JPEG"),
    "HEIC": heic(PIXELS, 6),
    "camera RAW": dng(PIXELS[:, :, 0].astype(np.uint16) * 16, 100, 4095),
    "JPEG, Adobe RGB": saved("JPEG", icc_profile=imagecodecs.cms_profile("adobergb")),
    **{
        f"TIFF, {name}": tiff(PIXELS, compression=name)
        for name in (None, "lzw", "zlib", "packbits", "lzma", "zstd")
    },
    "TIFF, 16 bits": tiff(PIXELS.astype(np.uint16), compression="zlib", predictor=True),
    "TIFF, floats": tiff(PIXELS.astype(np.float32), compression="zlib", predictor=True),
    "EXR": float_formats.encode_exr("RGB", PIXELS.astype(np.float32)),
}
NO_PICTURES = {
    "nothing": b"",
    "text": b"no picture",
    "cut": PNG[:-30],
    "too large": saved("PNG", np.zeros((4000, 5000, 3), np.uint8)),
}


def test_child_decodes_the_same_pixels(decoders: Decoders, subtests: pytest.Subtests) -> None:
    for name, data in PICTURES.items():
        with subtests.test(name):
            found = decoders.decode(data, "srgb")
            expected = decode.decode(data, "srgb", memory=MEMORY)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)


def test_child_refuses_with_the_same_error(decoders: Decoders, subtests: pytest.Subtests) -> None:
    for name, data in NO_PICTURES.items():
        with subtests.test(name):
            with pytest.raises(ImageError) as expected:
                decode.decode(data, "srgb", memory=MEMORY)
            with pytest.raises(ImageError) as found:
                decoders.decode(data, "srgb")
            assert (found.value.detail, found.value.fields) == (expected.value.detail, expected.value.fields)
    assert len(children()) == 1  # it is still usable


def test_children_are_started_as_needed_and_kept(decoders: Decoders) -> None:
    assert not children()
    for _ in range(5):
        decoders.decode(PNG, "srgb")
    assert len(children()) == 1
    with ThreadPoolExecutor(4) as threads:
        for found in threads.map(lambda _: decoders.decode(PNG, "srgb"), range(200)):
            np.testing.assert_array_equal(found, PIXELS)
    assert 1 <= len(children()) <= 4


def refusal_by_stopped_child(decoders: Decoders, after: Callable[[psutil.Process], None]) -> str:
    """The error about a picture whose decoder is suspended, and then has something done to it."""
    decoders.decode(PNG, "srgb")
    (child,) = children()
    child.suspend()
    with ThreadPoolExecutor(2) as threads:
        both = [threads.submit(decoders.decode, PNG, "srgb") for _ in range(2)]
        (done,), (left,) = futures.wait(both, return_when=futures.FIRST_COMPLETED)
        np.testing.assert_array_equal(done.result(), PIXELS)  # by another child
        after(child)
        with pytest.raises(ImageError) as refused:
            left.result()
    until(lambda: not alive([child]))
    np.testing.assert_array_equal(decoders.decode(PNG, "srgb"), PIXELS)
    return refused.value.detail


def test_killed_child_fails_only_its_own_picture(decoders: Decoders) -> None:
    assert "(SIGKILL)" in refusal_by_stopped_child(decoders, lambda child: child.kill())


@pytest.mark.slow
def test_child_that_hangs_is_ended_after_the_time_limit() -> None:
    impatient = Decoders(MEMORY, seconds=8)
    assert "takes more than 8 s" in refusal_by_stopped_child(impatient, lambda child: None)
    impatient.close()
    assert not children()


def test_idle_child_that_dies_is_replaced(decoders: Decoders) -> None:
    decoders.decode(PNG, "srgb")
    (child,) = children()
    child.kill()
    until(lambda: not psutil.pid_exists(child.pid))  # with all of its threads
    np.testing.assert_array_equal(decoders.decode(PNG, "srgb"), PIXELS)


def test_child_has_a_memory_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoder, "COPIES", 0)
    monkeypatch.setattr(decoder, "EXTRA", 32 << 20)
    confined = Decoders(1 << 30)
    large = saved("PNG", np.zeros((6000, 6000, 3), np.uint8))
    with pytest.raises(ImageError, match="too much memory"):
        confined.decode(large, "srgb")
    np.testing.assert_array_equal(confined.decode(PNG, "srgb"), PIXELS)
    confined.close()


def test_largest_allowed_picture_fits_in_memory() -> None:
    """16 bits with transparency and a colour profile: the case with the most copies."""
    noise = np.random.default_rng(1).integers(0, 1 << 16, (1000, 2000, 4), np.uint16)
    data = tiff(
        noise, compression="zlib", extrasamples=["unassalpha"], iccprofile=imagecodecs.cms_profile("adobergb")
    )
    decoders = Decoders(noise.nbytes)
    assert decoders.decode(data, "srgb").shape == noise.shape
    decoders.close()


def test_closed_pool_is_unavailable(decoders: Decoders) -> None:
    decoders.decode(PNG, "srgb")
    decoders.close()
    assert not children()
    with pytest.raises(Unavailable, match="stopped"):
        decoders.decode(PNG, "srgb")


def test_child_has_resource_limits(decoders: Decoders) -> None:
    decoders.decode(PNG, "srgb")
    (child,) = children()
    assert child.rlimit(psutil.RLIMIT_CORE) == (0, 0)
    assert child.rlimit(psutil.RLIMIT_FSIZE) == (0, 0)
    room = decoder.room(MEMORY)
    assert room <= child.rlimit(psutil.RLIMIT_DATA)[1] < room + (4 << 30)
