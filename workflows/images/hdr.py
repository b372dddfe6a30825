"""Codes for HDR displays (ITU-R BT.2100) as those of sRGB: phones film so by default.

Light is that of the scene, without a display's system gamma: light of several sources adds up. The white of pages and
skies in HDR, 203 cd/m2 or 75 % of HLG (ITU-R BT.2408, sect. 3), becomes white; what is brighter is clipped, unless room
is made for it.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from workflows.images.tone_curves import from_light

PQ, HLG = 16, 18
"""Transfer characteristics (ITU-T H.273, table 3)."""
BT_2020 = 9
"""Colour primaries (table 2 there)."""
WHITE = 203.0
"""Of PQ, in cd/m2."""
TO_SRGB = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""From the primaries of BT.2020 to those of sRGB (ITU-R BT.2407, sect. 2.2)."""
BAND = 1 << 18
"""Pixels that are converted at a time."""
TOP = 65535
HEADROOM = 1.1
"""Full scale relative to the brightest of a monitor: leaves room for noise and for what compression overshoots."""
ALL_BUT_OVERSHOOTS = 99.9
"""The percentile that is the brightest: compression makes single values up to a quarter too bright."""


def is_hdr(transfer: int) -> bool:
    """Whether these transfer characteristics are for HDR displays."""
    return transfer in (PQ, HLG)


def full_scale(transfer: int, brightest: NDArray[np.float32], darkest: NDArray[np.float32]) -> float:
    """The light that a capture's frames are to have at full scale: more than white if they show a monitor brighter.

    Parameters
    ----------
    transfer : int
        `PQ` or `HLG`.
    brightest, darkest : (...) float32
        The light of some places at which the frames have most and least, 1 for white.

    Notes
    -----
    A camera whose exposure is set by a dark room puts the monitor into the room for highlights, where nothing of it is
    lost. A lamp, which is no darker when the monitor is black, does not count.
    """
    of_monitor = brightest[darkest < brightest / 2]
    peak = float(np.percentile(of_monitor, ALL_BUT_OVERSHOOTS)) if of_monitor.size else 0.0
    return float(np.clip(HEADROOM * peak, 1, light_of_hdr(transfer)[-1]))


def to_srgb(
    codes: NDArray[np.uint16], transfer: int, primaries: int, full: float = 1.0
) -> NDArray[np.uint16]:
    """Convert RGB, or grey, for HDR displays to sRGB.

    Parameters
    ----------
    codes : (height, width, 3 or 1) uint16
        Full range.
    transfer : int
        `PQ` or `HLG`.
    primaries : int
        Those other than `BT_2020` are left alone.
    full : float
        The light that becomes full scale; 1 is white.

    Returns
    -------
    (height, width, 3 or 1) uint16
    """
    light_of, code_of = light_of_hdr(transfer) / np.float32(full), _codes()
    found = np.empty_like(codes)
    rows = max(1, BAND // codes.shape[1])
    for first in range(0, len(codes), rows):
        at = slice(first, first + rows)
        light = light_of[codes[at]]
        if primaries == BT_2020 and codes.shape[2] == 3:
            light = light @ TO_SRGB.T
        found[at] = code_of[np.rint(np.clip(light, 0, 1) * np.float32(TOP)).astype(np.uint16)]
    return found


@cache
def light_of_hdr(transfer: int) -> NDArray[np.float32]:
    """The light of every code of 16 bits, 1 for white (BT.2100, tables 4 and 5)."""
    code = np.arange(TOP + 1) / TOP
    if transfer == PQ:
        root = code ** (32 / 2523)
        light = (np.maximum(root - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * root)) ** (8192 / 1305)
        return (light * 10_000 / WHITE).astype(np.float32)
    a, b, c = 0.17883277, 0.28466892, 0.55991073

    def of(code: NDArray[np.float64] | float) -> NDArray[np.float64]:
        return np.where(np.asarray(code) <= 0.5, np.square(code) / 3, (np.exp((code - c) / a) + b) / 12)

    return (of(code) / of(0.75)).astype(np.float32)


@cache
def _codes() -> NDArray[np.uint16]:
    """The code of sRGB for every light in 65535ths."""
    light = np.arange(TOP + 1, dtype=np.float32) / np.float32(TOP)
    return np.rint(from_light(light, "srgb") * TOP).astype(np.uint16)
