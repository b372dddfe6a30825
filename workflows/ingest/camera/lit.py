"""Which pixels see the monitor: the others, of a dark room, tell nothing of the camera or of the glass."""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack, thumbnail_edge, thumbnail_mask
from workflows.images.tone_curves import Curve, to_light
from workflows.ingest.light.stack_attributes import shortest_frames
from workflows.programs.program import Program

SHARE = 0.03
"""Difference of a white and a black monitor from which on a pixel sees it, as a share of the brightest pixels'."""
BRIGHTEST = 0.98
"""The quantile of the blocks with pixels to be recovered that tells how bright these are."""


def find_lit(stack: Stack, program: Program) -> NDArray[np.bool_]:
    """Which pixels see the monitor, (y, x).

    All do in captures of earlier versions, and where no pixel to be recovered is brighter before a white monitor.

    Notes
    -----
    By the means of blocks of pixels, in the shortest exposure. It is the least that white exceeds black by in any two
    frames that counts, since the border of a film differs between them. Codes of an unknown curve are taken as sRGB.
    """
    every = np.ones((stack.height, stack.width), bool)
    ends = program.ends(stack.attributes["patterns"])
    black, white = (stack.thumbnails(shortest_frames(stack.attributes, end)) for end in ends)
    if black is None or white is None or not len(black) or not len(white):
        return every
    dark, bright = (light_of_thumbnails(part, stack.attributes["response"]) for part in (black, white))
    exceeds = bright.min(axis=0) - dark.max(axis=0)
    brightest = np.quantile(exceeds[thumbnail_mask(stack.mask())], BRIGHTEST)
    if brightest <= 0:
        return every
    seen: NDArray[np.bool_] = exceeds > SHARE * brightest
    edge = thumbnail_edge(stack.height, stack.width)
    return seen.repeat(edge, axis=0)[: stack.height].repeat(edge, axis=1)[:, : stack.width]


def light_of_thumbnails(codes: NDArray[np.uint16], response: Any) -> NDArray[np.float32]:
    """The approximate light of some blocks of thumbnails."""
    return to_light(codes.astype(np.float32) / np.float32(65535), rough_curve(response))


def rough_curve(response: Any) -> Curve:
    """A curve that is close enough to compare light by, of a camera or a monitor."""
    return "linear" if response == "linear" else "srgb"


def windows(seen: NDArray[np.bool_], edge: int) -> list[tuple[slice, slice]]:
    """Up to four by four rectangles, of ``edge`` pixels a side at most, spread over all that is seen, (y, x)."""

    def spread(some: NDArray[np.bool_]) -> list[slice]:
        first, last = np.flatnonzero(some)[[0, -1]].tolist()
        size = last + 1 - first
        length = min(edge, -(-size // 4))
        starts = {first + (size - length) * k // 3 for k in range(4)}
        return [slice(start, start + length) for start in sorted(starts)]

    return list(product(spread(np.any(seen, axis=1)), spread(np.any(seen, axis=0))))
