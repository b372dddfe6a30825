"""Contact sheets: small pictures of any capture, with what is clipped marked."""

import io
import math
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image, ImageFont

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from workflows.images.integer_formats import encode_png
from workflows.ingest.report.contact_sheet import AT_BLACK, AT_WHITE, HEIGHT, WIDTH, contact_sheet, thumbnail
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

Ingest = Callable[..., Stack]
MANIFEST = {
    "format": "envmatte-capture/1",
    "program": {
        "monitor": {"width": 64, "height": 48},
        "parts": [
            {"kind": "constant", "levels": [0, 1]},
            {"kind": "stripes", "axis": "x", "count": 2},
        ],
    },
    "frames": [{"file": f"{n}.png", "pattern": n} for n in range(4)],
}

CAPTION = math.ceil(ImageFont.load_default(12).getlength("frame 1: brightest"))
"""Width of the widest caption of its frames."""


@pytest.mark.parametrize(
    ("width", "height"), [(40, 30), (30, 40), pytest.param(500, 31, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("depth", [8, 16])
def test_clipped_pixels_are_marked(ingest: Ingest, width: int, height: int, depth: int) -> None:
    target = io.BytesIO()
    scene = glass_ball(width, height, monitor=(64, 48), rays=4)
    program = nested_program((64, 48), bands=((4, 3, 4), (8, 6, 5)), levels=3)
    write_capture(scene, program, target, gain=1.2, offset=0.0, noise=0, depth=depth)
    stack = ingest("c", target.getvalue())
    with Image.open(io.BytesIO(contact_sheet(stack))) as sheet:
        assert sheet.format == "PNG"
        pixels = np.asarray(sheet)
    assert pixels.shape[1] <= 4 * (WIDTH + 8) + 8
    assert pixels.shape[0] <= 5 * (HEIGHT + 30)
    first = slice(8, 8 + width // -(-width // WIDTH))
    black = pixels[8, first]
    assert (black == AT_BLACK).all(axis=1).mean() > 0.9
    assert (pixels == AT_WHITE).all(axis=2).sum() > 20
    column = (pixels.shape[1] - 8) // 4
    for between in range(4):  # captions stay within their columns
        assert (pixels[:, between * column : between * column + 8] == 32).all()


@pytest.mark.parametrize(("width", "height", "size"), [(3000, 1, (230, 1)), (1, 3000, (1, 230))])
def test_frames_of_one_row_or_column_are_drawn(
    ingest: Ingest, make_zip: Callable[..., bytes], width: int, height: int, size: tuple[int, int]
) -> None:
    files = {f"{n}.png": encode_png(np.full((height, width, 1), 60 * n + 9, np.uint8)) for n in range(4)}
    stack = ingest("c", make_zip(MANIFEST, files))
    with Image.open(io.BytesIO(thumbnail(stack))) as small:
        assert small.size == size
    with Image.open(io.BytesIO(contact_sheet(stack))) as sheet:
        assert sheet.size == (4 * (max(size[0], CAPTION) + 8) + 8, size[1] + 18 + 16)


def test_grey_frames_have_one_too(ingest: Ingest, make_zip: Callable[..., bytes]) -> None:
    files = {f"{n}.png": encode_png(np.full((12, 16, 1), 60 * n + 9, np.uint8)) for n in range(4)}
    with Image.open(io.BytesIO(contact_sheet(ingest("c", make_zip(MANIFEST, files))))) as sheet:
        assert sheet.size == (4 * (CAPTION + 8) + 8, 12 + 18 + 16)
    with Image.open(io.BytesIO(thumbnail(ingest("d", make_zip(MANIFEST, files))))) as small:
        assert (small.size, small.getcolors()) == ((16, 12), [(192, (69, 69, 69))])  # the white frame
