"""A contact sheet of a capture: some of its frames, with clipped pixels marked."""

import io
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from storage.layout.captures import Stack
from workflows.images.tone_curves import from_light, light_of_codes
from workflows.ingest.light.stack_attributes import look_up_of, program_of
from workflows.interruption import checkpoint
from workflows.programs.program import Program

WIDTH, HEIGHT = 240, 240
"""Largest size of a thumbnail in pixels."""
ACROSS = 4
"""Thumbnails in a row."""
EACH = 2
"""Patterns shown of each part."""
PARTS = 9
"""Parts shown, at most."""
ROWS = 64
"""Rows of the frames that are read at a time."""
CAPTION = 18
"""Height of a caption in pixels."""
AT_WHITE, AT_BLACK = (255, 0, 0), (0, 90, 255)


def contact_sheet(stack: Stack) -> bytes:
    """Draw the darkest and the brightest constant frame and some patterns of each part.

    Returns
    -------
    bytes
        A PNG. A thumbnail's pixel is red where any value in it is clipped at white, and blue where at black.
    """
    program = program_of(stack.attributes)
    picked = _pick(stack, program)
    light, high, low = _shrink(stack, [frame for frame, _ in picked])
    height, width = light.shape[1:3]
    rows = -(-len(picked) // ACROSS)
    across = min(ACROSS, len(picked))
    font = ImageFont.load_default(12)
    # Upright or small frames are narrower than their captions.
    column = max(width, *(ceil(font.getlength(caption)) for _, caption in picked)) + 8
    sheet = Image.new("RGB", (across * column + 8, rows * (height + CAPTION + 8) + 8), (32, 32, 32))
    draw = ImageDraw.Draw(sheet)
    for at, (_, caption) in enumerate(picked):
        x, y = 8 + at % ACROSS * column, 8 + at // ACROSS * (height + CAPTION + 8)
        values = _codes(light[at])
        values[low[at]], values[high[at]] = AT_BLACK, AT_WHITE
        sheet.paste(Image.fromarray(values), (x, y))
        draw.text((x, y + height + 2), caption, (220, 220, 220), font)
    return _png(sheet)


def thumbnail(stack: Stack) -> bytes:
    """Draw the brightest constant frame, which shows the object best; returns a PNG."""
    picked = _pick(stack, program_of(stack.attributes))
    frame = next((frame for frame, caption in picked if caption.endswith("brightest")), 0)
    light, _, _ = _shrink(stack, [frame])
    return _png(Image.fromarray(_codes(light[0])))


def _codes(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    values = np.rint(from_light(np.clip(light, 0, 1), "srgb") * 255).astype(np.uint8)
    return np.repeat(values, 3 // values.shape[2], axis=2)


def _png(picture: Image.Image) -> bytes:
    target = io.BytesIO()
    picture.save(target, "PNG")
    return target.getvalue()


def bytes_of_contact_sheet(stack: Stack) -> int:
    """Bytes that `contact_sheet` takes at most: some rows of all frames as they are read, and of one as light."""
    frames = 2 + EACH * PARTS
    value = stack.channels * stack.width * max(ROWS, _factor(stack))
    of_thumbnails = 3 * (4 + 2) * WIDTH * HEIGHT * frames
    return (2 * frames * stack.dtype.itemsize + 8) * value + of_thumbnails


def _pick(stack: Stack, program: Program) -> list[tuple[int, str]]:
    """The frames to show, and their captions."""
    darkest, brightest = program.ends()
    chosen = {int(darkest[0]): "darkest", int(brightest[0]): "brightest"}
    patterned = [
        (part, start, end)
        for part, (start, end) in zip(program.parts, pairwise(program.starts), strict=True)
        if part.kind != "constant"
    ]
    spread = np.unique(np.linspace(0, len(patterned) - 1, min(PARTS, len(patterned))).astype(int))
    for part, start, end in (patterned[at] for at in spread):
        grid = f" {part.columns} x {part.rows}" if part.kind == "bernoulli" else ""
        for number in np.unique(np.linspace(start, end - 1, EACH).astype(int)).tolist():
            chosen[number] = part.kind + grid
    patterns = stack.attributes["patterns"]
    exposures = stack.attributes["exposures"]
    frames = sorted(range(len(patterns)), key=lambda n: (exposures[n], n))
    first: dict[int, int] = {}
    for frame in frames:
        first.setdefault(patterns[frame], frame)
    return [
        (first[number], f"frame {first[number]}: {what}")
        for number, what in chosen.items()
        if number in first
    ]


def _shrink(
    stack: Stack, frames: list[int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """The light of frames at the size of thumbnails, and where it is clipped high and low; read in bands of rows."""
    # Frames may be lower or narrower than one square.
    down, across = (min(_factor(stack), edge) for edge in (stack.height, stack.width))
    height, width = stack.height // down, stack.width // across
    # Full scale is shown as white, whatever the camera's curve.
    top = np.iinfo(stack.dtype).max
    look_up = look_up_of(stack)
    light = np.zeros((len(frames), height, width, stack.channels), np.float32)
    high, low = (np.zeros((len(frames), height, width), bool) for _ in range(2))
    band = max(1, ROWS // down)
    for first in range(0, height, band):
        last = min(first + band, height)
        codes = stack.read_frames(frames, slice(first * down, last * down), slice(0, width * across))
        for number, of_frame in enumerate(codes):
            checkpoint()
            cells = of_frame.reshape(last - first, down, width, across, stack.channels)
            light[number, first:last] = light_of_codes(cells, look_up).mean(axis=(1, 3))
            high[number, first:last] = (cells == top).any(axis=(1, 3, 4))
            low[number, first:last] = (cells == 0).any(axis=(1, 3, 4))
    return light, high, low


def _factor(stack: Stack) -> int:
    """Edge of the squares of pixels that become one of a thumbnail."""
    return max(1, -(-stack.width // WIDTH), -(-stack.height // HEIGHT))
