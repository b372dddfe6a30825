"""WebP, AVIF and GIF: decoded as browsers show them, and refused in plain words."""

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageCms

from storage.errors import ImageError
from workflows.images import decode, integer_formats

MEMORY = 1 << 20
WIDTH, HEIGHT = 48, 32
ACROSS, DOWN = np.meshgrid(np.linspace(20, 230, WIDTH), np.linspace(30, 200, HEIGHT))
PIXELS = np.stack([ACROSS, DOWN, 255 - ACROSS], axis=2).astype(np.uint8)
ALPHA = np.where(DOWN > 100, 255, 0).astype(np.uint8)
LIBRARY = ("error", "exception", "attack", "bomb", "webp_", "avif_", "decoder object", "pillow", "pil.")
"""How libraries speak."""


def saved(kind: str, pixels: np.ndarray = PIXELS, **options: Any) -> bytes:
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, **options)
    return target.getvalue()


def moving(kind: str, **options: Any) -> bytes:
    target = io.BytesIO()
    frames = [Image.fromarray(PIXELS), Image.fromarray(255 - PIXELS)]
    frames[0].save(target, kind, save_all=True, append_images=frames[1:], **options)
    return target.getvalue()


def decoded(data: bytes) -> np.ndarray:
    return decode.decode(data, "srgb", memory=MEMORY)


def error_of(data: bytes) -> str:
    with pytest.raises(ImageError) as caught:
        decoded(data)
    detail = caught.value.detail
    assert not any(word in detail.lower() for word in LIBRARY), detail
    return detail


FILES = {
    "WebP": saved("WEBP", quality=95),
    "lossless WebP": saved("WEBP", lossless=True),
    "moving WebP": moving("WEBP", lossless=True),
    "AVIF": saved("AVIF", quality=95, subsampling="4:4:4"),
    "moving AVIF": moving("AVIF", quality=95, subsampling="4:4:4"),
    "GIF": saved("GIF"),
    "moving GIF": moving("GIF"),
}


@pytest.mark.parametrize("name", FILES)
def test_backdrops_of_web_formats_show_their_first_frame(name: str) -> None:
    found = decoded(FILES[name])
    assert (found.shape, found.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)
    worst = 40 if "GIF" in name else 12
    assert np.abs(found.astype(int) - PIXELS).max() <= worst


@pytest.mark.parametrize("name", FILES)
def test_captures_do_not_take_web_formats(name: str) -> None:
    with pytest.raises(ImageError, match="not a PNG, TIFF, JPEG or HEIC image"):
        integer_formats.decode(FILES[name], memory=MEMORY)


@pytest.mark.parametrize("kind", ["WEBP", "AVIF", "GIF"])
def test_transparency_is_kept(kind: str) -> None:
    options = {} if kind == "GIF" else {"quality": 95}
    found = decoded(saved(kind, np.dstack([PIXELS, ALPHA]), **options))
    assert found.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(found[..., 3] > 128, ALPHA > 128)


@pytest.mark.parametrize("kind", ["WEBP", "AVIF"])
def test_orientation_and_profile_are_applied(kind: str) -> None:
    exif = Image.Exif()
    exif[274] = 6
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    found = decoded(saved(kind, quality=100, exif=exif, icc_profile=profile))
    assert found.shape == (WIDTH, HEIGHT, 3)
    turned = np.rot90(PIXELS, -1)
    assert np.abs(found.astype(int) - turned).mean() < 4


def huge() -> dict[str, bytes]:
    """Small files that claim to be large."""
    extended = bytearray(saved("WEBP", np.dstack([PIXELS, ALPHA])))
    assert extended[12:16] == b"VP8X"
    extended[24:30] = (16_383).to_bytes(3, "little") * 2
    lossless = bytearray(saved("WEBP", lossless=True))
    assert lossless[12:16] == b"VP8L"
    lossless[21:25] = (int.from_bytes(lossless[21:25], "little") | 0x0FFFFFFF).to_bytes(4, "little")
    lossy = bytearray(saved("WEBP"))
    assert lossy[12:16] == b"VP8 "
    lossy[26:30] = b"\xff\x3f\xff\x3f"
    avif = bytearray(saved("AVIF"))
    at = avif.index(b"ispe") + 8
    avif[at : at + 8] = (16_000).to_bytes(4, "big") * 2
    gif = bytearray(saved("GIF"))
    gif[6:10] = b"\xff\xff\xff\xff"
    return {name: bytes(data) for name, data in locals().items() if isinstance(data, bytearray)}


@pytest.mark.parametrize("name", ["extended", "lossless", "lossy", "avif", "gif"])
def test_picture_that_claims_to_be_huge_is_refused_before_it_is_decoded(name: str) -> None:
    assert "takes more than the 1048576 bytes allowed for one: make it smaller" in error_of(huge()[name])


def test_bomb_is_refused_in_plain_words() -> None:
    assert "make it smaller" in error_of(saved("PNG", np.zeros((20_000, 10_000), bool)))


@pytest.mark.parametrize("name", FILES)
def test_damaged_picture_is_refused_with_a_remedy(name: str) -> None:
    whole = FILES[name]
    for share in (0.02, 0.1, 0.3, 0.5):
        data = whole[: max(int(share * len(whole)), 14)]
        try:
            decoded(data)
        except ImageError:
            detail = error_of(data)
            assert "save it" in detail or "copy it again" in detail
    for seed in range(60):
        random = np.random.default_rng(seed)
        broken = bytearray(whole)
        for at in random.integers(12, len(broken), 8):
            broken[at] = random.integers(256)
        try:
            decoded(bytes(broken))
        except ImageError:
            error_of(bytes(broken))
