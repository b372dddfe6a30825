"""Images: how damaged ones are made, and what must hold for their pixels."""

import io
from pathlib import Path
from random import Random

import numpy as np
from PIL import Image

from tests.fuzzing import changes, seeds
from tests.fuzzing.campaign import LIMITS, Refused
from tests.fuzzing.seeds import Files
from workflows.composite.backdrops.backdrop import backdrop_of
from workflows.images import camera_raw, decode, float_formats, integer_formats

BOXES = b"|".join(
    b"ftyp meta pitm iloc iinf infe iref iprp ipco ipma ispe irot imir hvcC colr pixi auxC".split()
)
"""Boxes of a HEIC."""


def read_image(data: bytes, folder: Path) -> None:
    integer_formats.orientation(data)
    pixels = integer_formats.decode(data, memory=LIMITS.image_bytes)
    assert pixels.dtype in (np.uint8, np.uint16)
    assert pixels.ndim == 3
    assert pixels.shape[2] in (1, 3)
    assert 0 < pixels.nbytes <= LIMITS.image_bytes


def read_any_backdrop(data: bytes, folder: Path) -> None:
    backdrop = backdrop_of(decode.decode(data, "srgb", memory=LIMITS.image_bytes), "srgb")
    pixels = backdrop.pixels
    assert pixels.ndim == 3
    assert 0 < pixels.nbytes <= 4 * LIMITS.image_bytes
    assert np.isfinite(pixels).all()


def read_floats(data: bytes, folder: Path) -> None:
    if not float_formats.is_float(data):
        raise Refused
    light = float_formats.decode(data, memory=LIMITS.image_bytes)
    assert light.dtype == np.float32
    assert light.ndim == 3
    assert light.shape[2] in (1, 3)
    assert 0 < light.nbytes <= LIMITS.image_bytes


def read_raw(data: bytes, folder: Path) -> None:
    light = camera_raw.decode(data, memory=LIMITS.image_bytes)
    assert light.dtype == np.float32
    assert light.ndim == 3
    assert light.shape[2] == 3
    assert light.nbytes <= LIMITS.image_bytes


def make_raw(random: Random, valid: Files) -> bytes:
    if random.random() < 0.3:
        body = random.choice((b"", random.choice(valid)))
        other = random.choice(seeds.MAGICS) + body + random.randbytes(random.choice((16, 200, 4000)))
        return changes.damaged(random, other)
    return random.choice((changes.damaged, changes.damaged_tiff))(random, random.choice(valid))


def profiled(random: Random, data: bytes) -> bytes:
    """A PNG with a damaged colour profile."""
    target = io.BytesIO()
    profile = changes.damaged(random, seeds.profile(), rb"desc|curv|para|XYZ |A2B0|B2A0|mft2|TRC")
    Image.open(io.BytesIO(seeds.pngs()[0])).save(target, "PNG", icc_profile=profile)
    return target.getvalue()
