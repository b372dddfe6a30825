"""A picture of where a pixel's light comes from on the monitor."""

import io
import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from workflows.mattes.pixel import Pixel, contribution

SCALE = 2
"""The sheet is drawn so many times as large and then reduced, for smooth lines and letters."""
WIDE, NARROW, MOST_HEIGHT = 492, 324, 640
"""Widths of the panels, two or three beside each other, and what they are high at most."""
GAP, CAPTION, LINE = 12, 22, 20
DECADES = 3
"""Powers of ten below the peak at which a contribution ends in black."""
SIGMAS = 2
"""Standard deviations at which a lobe's ellipse is drawn."""
REACH, WIDEST = 4, 0.3
"""Standard deviations around lobes that the close-up has room for, and what it may be wide for more than the first."""
INK, FAINT, PAPER, FRAME = (235, 235, 235), (150, 150, 150), (24, 24, 28), (80, 80, 88)
LOBE = (255, 208, 64)
HUES = {"red": (255, 64, 48), "green": (48, 220, 72), "blue": (72, 112, 255)}
Window = tuple[float, float, float, float]


def picture(pixel: Pixel) -> bytes:
    """Draw a pixel's contributions over the monitor.

    Returns
    -------
    bytes
        A PNG: the whole monitor, a close-up of where most light comes from, and the close-up channel by channel.
        Brightness is the logarithm of the contribution over three powers of ten; ellipses are the lobes, at two
        standard deviations; the lines below list their numbers.
    """
    aspect = pixel.monitor[1] / pixel.monitor[0]
    wide, narrow = (_fitting(width, aspect) for width in (WIDE, NARROW))
    left = [GAP, GAP + WIDE + GAP]
    top = GAP + 2 * LINE
    below = top + wide[1] + CAPTION + GAP
    lines = below + narrow[1] + CAPTION + GAP
    size = 3 * GAP + 2 * WIDE, lines + LINE * (1 + max(len(pixel.lobes), 1)) + GAP
    sheet = Image.new("RGB", (size[0] * SCALE, size[1] * SCALE), PAPER)
    pen = _Pen(sheet)
    pen.text(GAP, GAP, f"Pixel ({pixel.x}, {pixel.y}): where on the monitor its light comes from", INK, 16)
    pen.text(GAP, GAP + LINE + 2, f"log brightness, {DECADES} decades; ellipses at {SIGMAS} sigma", FAINT)
    window = _close_up(pixel, aspect)
    whole = (0.0, 0.0, 1.0, 1.0)
    for x, part, caption in ((left[0], whole, "the whole monitor"), (left[1], window, _caption(window))):
        at = (x, top, *wide)
        pen.panel(at, _in_colour(_brightness(contribution(pixel, part, *wide))))
        for number, lobe in enumerate(pixel.lobes):
            pen.lobe(at, part, lobe, aspect, number + 1, least=6 if part is whole else 2)
        if part is whole and window != whole:
            corners = [(window[n] * wide[0], window[n + 1] * wide[1]) for n in (0, 2)]
            pen.rectangle(x + corners[0][0], top + corners[0][1], x + corners[1][0], top + corners[1][1])
        pen.text(x, top + wide[1] + 3, caption, FAINT)
    shares = _brightness(contribution(pixel, window, *narrow))
    for channel, (name, hue) in enumerate(HUES.items()):
        at = (GAP + channel * (NARROW + GAP), below, *narrow)
        pen.panel(at, _tinted(shares[..., channel], hue))
        for lobe in pixel.lobes:
            pen.lobe(at, window, lobe, aspect, None, least=2)
        pen.text(at[0], below + narrow[1] + 3, name, FAINT)
    for number, line in enumerate(_lines(pixel)):
        pen.text(GAP, lines + number * LINE, line, INK if number else FAINT)
    target = io.BytesIO()
    sheet.reduce(SCALE).save(target, "PNG")
    return target.getvalue()


class _Pen:
    """Draws in pixels of the finished sheet."""

    def __init__(self, sheet: Image.Image) -> None:
        self._sheet = sheet
        self._draw = ImageDraw.Draw(sheet)

    def text(self, x: float, y: float, text: str, colour: tuple[int, int, int], size: int = 13) -> None:
        font = ImageFont.load_default(size * SCALE)
        self._draw.text((x * SCALE, y * SCALE), text, colour, font)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float) -> None:
        at = [v * SCALE for v in (min(x0, x1 - 6), min(y0, y1 - 6), x1, y1)]
        self._draw.rectangle(at, outline=INK, width=SCALE)

    def panel(self, at: tuple[int, int, int, int], pixels: NDArray[np.uint8]) -> None:
        x, y, width, height = (v * SCALE for v in at)
        image = Image.fromarray(pixels).resize((width, height), Image.Resampling.NEAREST)
        self._sheet.paste(image, (x, y))
        self._draw.rectangle((x - 1, y - 1, x + width, y + height), outline=FRAME, width=1)

    def lobe(
        self,
        at: tuple[int, int, int, int],
        window: Window,
        lobe: NDArray[np.float32],
        aspect: float,
        number: int | None,
        least: float,
    ) -> None:
        """An ellipse on a panel that shows a part of the monitor; a number beside it, if given one."""
        x, y, width, height = at
        u, v, _, _, _, sigma_u, sigma_v, theta = lobe.tolist()
        zoom = width / (window[2] - window[0])
        centre = x + (u - window[0]) * zoom, y + (1 - v - window[1]) * aspect * zoom
        axes = [max(SIGMAS * sigma * zoom, least) for sigma in (sigma_u, sigma_v)]
        if not (x <= centre[0] < x + width and y <= centre[1] < y + height):
            return
        turn = np.linspace(0, 2 * np.pi, 97)
        along, across = axes[0] * np.cos(turn), axes[1] * np.sin(turn)
        right = along * math.cos(theta) - across * math.sin(theta)
        up = along * math.sin(theta) + across * math.cos(theta)
        on_sheet = np.stack([centre[0] + right, centre[1] - up], axis=1)
        on_sheet = np.clip(on_sheet, [x, y], [x + width - 1, y + height - 1])
        self._draw.line([(a * SCALE, b * SCALE) for a, b in on_sheet.tolist()], LOBE, SCALE, joint="curve")
        if number is not None:
            beside = float(min(on_sheet[:, 0].max() + 3, x + width - 12))
            self.text(beside, min(max(centre[1] - 8, y), y + height - 18), str(number), LOBE)


def _fitting(width: int, aspect: float) -> tuple[int, int]:
    """The size of a panel of a width, or of what shows in it of a monitor that is higher than there is room."""
    height = round(width * aspect)
    return (
        (width, max(height, 1))
        if height <= MOST_HEIGHT
        else (max(round(MOST_HEIGHT / aspect), 1), MOST_HEIGHT)
    )


def _close_up(pixel: Pixel, aspect: float) -> Window:
    """A part of the monitor, of its shape, with the heaviest lobe and those beside it."""
    box: list[float] | None = None
    for u, v, _, _, _, sigma_u, sigma_v, _ in pixel.lobes.tolist():
        reach = REACH * max(sigma_u, sigma_v)
        near = [u - reach, 1 - v - reach / aspect, u + reach, 1 - v + reach / aspect]
        both = near if box is None else [*map(min, box[:2], near[:2]), *map(max, box[2:], near[2:])]
        if box is None or max(both[2] - both[0], both[3] - both[1]) <= WIDEST:
            box = both
    if box is None:
        return 0.0, 0.0, 1.0, 1.0
    side = min(max(box[2] - box[0], box[3] - box[1], 12 / pixel.columns), 1.0)
    start = [min(max((box[n] + box[n + 2] - side) / 2, 0.0), 1 - side) for n in (0, 1)]
    return start[0], start[1], start[0] + side, start[1] + side


def _brightness(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithms of contributions, 1 at the peak of all channels and 0 at the last decade."""
    peak = shares.max(initial=0)
    if peak == 0:
        return np.zeros_like(shares)
    brightness: NDArray[np.float64] = np.clip(1 + np.log10(np.maximum(shares / peak, 1e-12)) / DECADES, 0, 1)
    return brightness


def _in_colour(brightness: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(brightness * 255).astype(np.uint8)


def _tinted(brightness: NDArray[np.float64], hue: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Black through a hue to white."""
    ramp = np.array([(0, 0, 0), hue, (255, 255, 255)])
    colours = [np.interp(brightness, (0, 0.7, 1), ramp[:, c]) for c in range(3)]
    tinted: NDArray[np.uint8] = np.rint(np.stack(colours, axis=-1)).astype(np.uint8)
    return tinted


def _caption(window: Window) -> str:
    left, top, right, bottom = window
    return f"close-up: u {left:.3f} to {right:.3f}, v {1 - bottom:.3f} to {1 - top:.3f}"


def _lines(pixel: Pixel) -> list[str]:
    if not pixel.recovered:
        return ["not recovered: this pixel was left out"]
    if not len(pixel.lobes):
        return ["nothing could be recovered here: no cells, no lobes"]
    lines = [f"cells: {len(pixel.node)}; lobes, and the share of red, green and blue of each:"]
    for number, lobe in enumerate(pixel.lobes.tolist(), start=1):
        u, v, red, green, blue, sigma_u, sigma_v, theta = lobe
        lines.append(
            f"{number}:  {red:.1%}  {green:.1%}  {blue:.1%}   at u {u:.4f}, v {v:.4f},   sigma {sigma_u:.4f} by "
            f"{sigma_v:.4f},   turned by {math.degrees(theta):.0f} degrees"
        )
    return lines
