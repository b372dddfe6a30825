"""Camera RAW is recognised by its name and by its bytes, and other TIFFs are not taken for it."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import tifffile

from tests.parts.inputs.heics import heic
from workflows.images.raw_files import is_raw

COUNTS = np.random.default_rng(8).integers(200, 4000, (40, 60), np.uint16)
PIXELS = np.ones((40, 60, 3), np.uint16)
Dng = Callable[..., bytes]


def tiff(**options: Any) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, PIXELS, photometric="rgb", **options)
    return target.getvalue()


def nef(byteorder: str = ">") -> bytes:
    """A file as Nikon's cameras write it: a thumbnail, and the sensor's counts in an image that it refers to."""
    target = io.BytesIO()
    with tifffile.TiffWriter(target, byteorder=byteorder) as file:  # type: ignore[arg-type]
        file.write(np.full((8, 12, 3), 9, np.uint8), photometric="rgb", subfiletype=1, subifds=1)
        file.write(COUNTS, photometric="cfa")
    return target.getvalue()


@pytest.mark.parametrize("name", ["frames/IMG_0001.CR3", "a.dng", "a.NEF"])
def test_raw_is_recognised_by_its_name(name: str) -> None:
    assert is_raw(b"", name)


def test_raw_is_recognised_by_its_bytes(make_dng: Dng) -> None:
    thumbnail = np.zeros((8, 12, 3), np.uint8)
    for data in (
        make_dng(COUNTS, 256, 4095),
        make_dng(PIXELS, 256, 4095),
        make_dng(COUNTS, 256, 4095, thumbnail=thumbnail),
        nef(),
        nef("<"),
        nef()[:300],  # what follows the thumbnail's tags is cut off
        b"\0\0\0\x18ftypcrx \0\0\0\1crx isom",
        b"II*\0\x10\0\0\0CR\2\0" + bytes(50),
        b"FUJIFILMCCD-RAW 0201FF383501",
        b"IIRO\x08\0\0\0",
        b"IIU\0\x18\0\0\0",
    ):
        assert is_raw(data, "backdrop")


def test_other_pictures_are_not_raw() -> None:
    for data in (
        b"",
        tiff(),
        tiff(byteorder=">", compression="zlib"),
        tiff(bigtiff=True),
        heic(PIXELS[..., :3]),
    ):
        assert not is_raw(data, "dng/a.tif")
