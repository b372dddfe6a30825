"""A matte for graphics hardware: its lookups, S, rho and alpha in a few megabytes, as the web app draws it.

The format is a gzip stream of the header's length n in four bytes (little-endian), the header (n bytes of JSON), and
planes of bytes. Each plane has the header's ``width`` times ``height`` bytes, row by row:

- 8 planes for each of the header's ``lookups`` lookups, heaviest first. Four hold x and y, 16 bits each, the higher
  byte's plane first, as fractions of the texture's first level times 65536; each value is stored as its difference
  from the one to its left, modulo 65536. One holds the level times 16, three the channels' shares of light times 255.
- 3 planes of S and 3 of rho, one per channel: 255 times the square root of the value divided by the header's ``S`` or
  ``rho``.
- 1 plane of alpha: 255 where the pixel was recovered, else 0.

The header's ``levels`` are the columns and rows of the texture's levels. The first is padded to ``texture``, and the
others accordingly, so that each level is exactly half as large as the one before; padding repeats the edge. The
composite is ``S + crosstalk (rho * sum over lookups of share * texture)``.

If the object was cut out, the header says how a backdrop is fitted to the frame, see
`workflows.composite.backdrops.around`: by ``view`` it is placed over all that the frame sees, ``exposure`` is a matrix
that the composite is multiplied by, and by ``sight`` it is seen around the glass.

Only every ``step``-th row and column of a large matte is encoded.
"""

import gzip
import json
import math
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import exposure, over_frame
from workflows.composite.live.lookups import block_lookups
from workflows.recovery.pyramid import Pyramid
from workflows.threads import in_parts

FORMAT = "live-1"
"""To be changed whenever the encoded bytes change."""
LOOKUPS = 4
"""Lookups of a pixel."""
MOST_PIXELS = 1 << 19
"""Most pixels that are encoded; a larger matte is subsampled."""
SIXTEENTHS = 16
"""Codes per level of the texture."""
_PLANES = 8
"""Planes of a lookup."""
_GZIP_LEVEL = 6
"""Higher levels take twice as long for 1 % less."""


def encode_live(matte: Matte, threads: int, lookups: int = LOOKUPS, whole: Matte | None = None) -> bytes:
    """Encode a matte for graphics hardware.

    Parameters
    ----------
    matte : Matte
    threads : int
        Number of threads; the bytes do not depend on it.
    lookups : int
        Lookups of a pixel.
    whole : Matte, optional
        Whose preview the matte is.

    Returns
    -------
    bytes
        In the format of this module.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    step = _step(matte)
    ys, xs = (np.arange(step // 2, size, step) for size in (matte.height, matte.width))
    levels = Pyramid.over(matte.columns, matte.rows).grids
    coarsest = 1 << (len(levels) - 1)
    texture = [coarsest * size for size in levels[-1]]
    size = len(ys), len(xs)
    encoded = _Encoded(
        np.zeros((lookups, 3, *size), np.uint16),
        np.zeros((lookups, 3, *size), np.uint8),
        np.zeros((*size, 3), np.float32),
        np.zeros((*size, 3), np.float32),
        np.zeros(size, np.uint8),
    )
    blocks = list(product(range(matte.block_rows), range(matte.block_columns)))
    in_parts(
        lambda number: _encode_block(matte, *blocks[number], ys, xs, texture, encoded),
        range(len(blocks)),
        threads,
    )
    header = {
        "width": len(xs),
        "height": len(ys),
        "step": step,
        "lookups": lookups,
        "levels": levels,
        "texture": texture,
        "crosstalk": matte.attributes["crosstalk"],
        "S": max(float(encoded.S.max()), 1e-6),
        "rho": max(float(encoded.rho.max()), 1e-6),
    }
    return _pack(header | _fitted(whole or matte), encoded)


def _fitted(matte: Matte) -> dict[str, Any]:
    """What the header says of fitting a backdrop to the frame."""
    view = over_frame(matte, None)
    if view is None:
        return {}
    return {
        "view": {"right": view.right, "down": view.down, "scale": view.scale},
        "sight": matte.attributes["beside"]["sight"],
        "exposure": exposure(matte).tolist(),
    }


def bytes_of_live(matte: Matte) -> int:
    """Bytes that `encode_live` takes, apart from a block for each thread: codes, planes of bytes, and their copies."""
    pixels = -(-matte.width // _step(matte)) * -(-matte.height // _step(matte))
    return pixels * (9 * LOOKUPS + 25 + 3 * (_PLANES * LOOKUPS + 7) + 12)


def _step(matte: Matte) -> int:
    """Of how many rows and columns one is encoded."""
    return max(math.ceil(math.sqrt(matte.width * matte.height / MOST_PIXELS)), 1)


class _Encoded(NamedTuple):
    """The values of a matte that are encoded, for h rows and w columns of pixels.

    Attributes
    ----------
    codes : (lookups, 3, h, w) uint16
        x, y and level of each lookup.
    shares : (lookups, 3, h, w) uint8
        Its shares of each channel's light, in 255ths.
    S, rho : (h, w, 3) float32
    alpha : (h, w) uint8
    """

    codes: NDArray[np.uint16]
    shares: NDArray[np.uint8]
    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    alpha: NDArray[np.uint8]


def _encode_block(
    matte: Matte,
    row: int,
    column: int,
    ys: NDArray[np.integer],
    xs: NDArray[np.integer],
    texture: list[int],
    encoded: _Encoded,
) -> None:
    """Encode the pixels of a block that are in the rows `ys` and the columns `xs`; `encoded` is written."""
    block = matte.read(row, column)
    y, x = matte.span(row, column)
    in_block = [
        np.flatnonzero((positions >= part.start) & (positions < part.stop))
        for positions, part in ((ys, y), (xs, x))
    ]
    if not all(map(len, in_block)):
        return
    source = np.ix_(ys[in_block[0]] - y.start, xs[in_block[1]] - x.start)
    target = slice(in_block[0][0], in_block[0][-1] + 1), slice(in_block[1][0], in_block[1][-1] + 1)
    wanted = np.zeros(block.recovered.shape, bool)
    wanted[source] = True
    lookups = len(encoded.codes)
    fitted = np.moveaxis(block_lookups(matte, block, lookups, wanted)[source], (0, 1), (2, 3))
    for code, scale in enumerate((65536 / texture[0], 65536 / texture[1], SIXTEENTHS)):
        encoded.codes[:, code, *target] = np.minimum(np.rint(fitted[:, code] * np.float32(scale)), 65535)
    encoded.shares[:, :, *target] = _quantise_shares(fitted[:, 3:])
    encoded.S[target], encoded.rho[target] = block.S[source], block.rho[source]
    encoded.alpha[target] = 255 * block.recovered[source]


def _quantise_shares(shares: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Round shares of light (lookups, 3, ...) to 255ths; the heaviest lookup absorbs the rounding errors."""
    rounded = np.rint(shares * np.float32(255)).astype(np.int64)
    total = np.rint(shares.sum(axis=0) * np.float32(255)).astype(np.int64)
    rounded[0] += total - rounded.sum(axis=0)
    codes: NDArray[np.uint8] = np.clip(rounded, 0, 255).astype(np.uint8)
    return codes


def _pack(header: dict[str, Any], encoded: _Encoded) -> bytes:
    """Compress the header and the planes."""
    planes = np.empty((_PLANES * len(encoded.codes) + 7, *encoded.alpha.shape), np.uint8)
    for k, (codes, shares) in enumerate(zip(encoded.codes, encoded.shares, strict=True)):
        of_lookup = planes[_PLANES * k :]
        steps = np.diff(codes[:2], axis=2, prepend=np.uint16(0))
        of_lookup[0:4:2], of_lookup[1:4:2] = steps >> 8, steps & 255
        of_lookup[4], of_lookup[5:8] = codes[2], shares
    for name, image, first in (("S", encoded.S, -7), ("rho", encoded.rho, -4)):
        root = np.sqrt(np.clip(image / np.float32(header[name]), 0, 1))
        planes[first : first + 3] = np.rint(255 * np.moveaxis(root, 2, 0))
    planes[-1] = encoded.alpha
    head = json.dumps(header).encode()
    return gzip.compress(len(head).to_bytes(4, "little") + head + planes.tobytes(), _GZIP_LEVEL, mtime=0)
