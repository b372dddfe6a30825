"""A matte for graphics hardware: its lookups, S, rho and alpha in a few megabytes, as the web app draws it.

A gzip stream of four bytes, the length n of the header (little-endian); the header, n bytes of JSON; and planes of
bytes, one after another, each of the header's ``width`` times ``height``, row by row:

- of each lookup, from the heaviest on, ``lookups`` times: x and y, 16 bits each in two planes, the higher byte's first,
  as shares of the texture's first level; the level in sixteenths; and the channels' shares of light, of 255. Of x and
  y the planes hold what is to be added, modulo 65536, to the value before in the row;
- S and then rho, by channel: the square root, as a share of 255 of the square root of the header's ``S`` and ``rho``;
- alpha: 255 where the pixel was recovered.

The texture's levels have the columns and rows that the header's ``levels`` name, of which the first is padded to
``texture``, so that each level is exactly half as large as the one before: what lies beyond a level's columns and rows
is as its edge. The glass before a backdrop is then ``S + crosstalk (rho * sum over lookups of share * texture)``.

Of a large matte only every ``step``-th pixel is encoded.
"""

import gzip
import json
import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.composite.live.lookups import FIELDS, fit_lookups
from workflows.composite.threads import in_parts
from workflows.recovery.pyramid import Pyramid

FORMAT = "live-1"
"""Changes with every change of the bytes."""
LOOKUPS = 4
"""Lookups of a pixel."""
MOST_PIXELS = 1 << 19
"""Most pixels that are encoded; a larger matte is subsampled."""
SIXTEENTHS = 16
_PLANES = 8
"""Of a lookup."""
_LEVEL = 6
"""Of gzip: higher ones take twice as long for 1 % less."""


def encode_live(matte: Matte, threads: int, lookups: int = LOOKUPS) -> bytes:
    """A matte for graphics hardware.

    Parameters
    ----------
    matte : Matte
    threads : int
        To share the work; the bytes are the same.
    lookups : int
        Of a pixel.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    step = max(math.ceil(math.sqrt(matte.width * matte.height / MOST_PIXELS)), 1)
    ys, xs = (np.arange(step // 2, size, step) for size in (matte.height, matte.width))
    levels = Pyramid.over(matte.columns, matte.rows).grids
    whole = 1 << (len(levels) - 1)
    texture = [whole * size for size in levels[-1]]
    codes = np.zeros((lookups, 3, len(ys), len(xs)), np.uint16)
    shares = np.zeros((lookups, 3, len(ys), len(xs)), np.uint8)
    frames = {name: np.zeros((len(ys), len(xs), 3), np.float32) for name in ("S", "rho")}
    alpha = np.zeros((len(ys), len(xs)), np.uint8)
    blocks = list(product(range(matte.block_rows), range(matte.block_columns)))

    def one(number: int) -> None:
        row, column = blocks[number]
        block = matte.read(row, column)
        y, x = matte.span(row, column)
        sampled = [
            np.flatnonzero((places >= part.start) & (places < part.stop))
            for places, part in ((ys, y), (xs, x))
        ]
        if not all(map(len, sampled)):
            return
        of_block = np.ix_(ys[sampled[0]] - y.start, xs[sampled[1]] - x.start)
        at = slice(sampled[0][0], sampled[0][-1] + 1), slice(sampled[1][0], sampled[1][-1] + 1)
        wanted = np.zeros(block.recovered.shape, bool)
        wanted[of_block] = True
        fitted = fit_lookups(
            matte.columns,
            matte.rows,
            block.count.reshape(-1, 3),
            block.shared.reshape(-1),
            block.cell,
            block.weight,
            lookups,
            wanted.reshape(-1),
        ).reshape(*block.recovered.shape, lookups, len(FIELDS))[of_block]
        fitted = np.moveaxis(fitted, (0, 1), (2, 3))
        for code, scale in enumerate((65536 / texture[0], 65536 / texture[1], SIXTEENTHS)):
            codes[:, code, *at] = np.minimum(np.rint(fitted[:, code] * np.float32(scale)), 65535)
        shares[:, :, *at] = _in_bytes(fitted[:, 3:])
        for name, frame in frames.items():
            frame[at] = getattr(block, name)[of_block]
        alpha[at] = 255 * block.recovered[of_block]

    in_parts(one, range(len(blocks)), threads)
    tops = {name: max(float(frame.max()), 1e-6) for name, frame in frames.items()}
    header = {
        "width": len(xs),
        "height": len(ys),
        "step": step,
        "lookups": lookups,
        "levels": levels,
        "texture": texture,
        "crosstalk": matte.attributes["crosstalk"],
        **tops,
    }
    return _packed(header, codes, shares, frames, alpha)


def _in_bytes(shares: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Shares of light (lookups, 3, ...) in 255ths; the heaviest lookup makes up for what rounding takes or adds."""
    rounded = np.rint(shares * np.float32(255)).astype(np.int64)
    total = np.rint(shares.sum(axis=0) * np.float32(255)).astype(np.int64)
    rounded[0] += total - rounded.sum(axis=0)
    codes: NDArray[np.uint8] = np.clip(rounded, 0, 255).astype(np.uint8)
    return codes


def _packed(
    header: dict[str, Any],
    codes: NDArray[np.uint16],
    shares: NDArray[np.uint8],
    frames: dict[str, NDArray[np.float32]],
    alpha: NDArray[np.uint8],
) -> bytes:
    planes = np.empty((_PLANES * len(codes) + 7, *alpha.shape), np.uint8)
    for k, (lookup, of_channels) in enumerate(zip(codes, shares, strict=True)):
        to = planes[_PLANES * k :]
        steps = np.diff(lookup[:2], axis=2, prepend=np.uint16(0))
        to[0:4:2], to[1:4:2] = steps >> 8, steps & 255
        to[4], to[5:8] = lookup[2], of_channels
    for to, (name, frame) in zip((planes[-7:-4], planes[-4:-1]), frames.items(), strict=True):
        root = np.sqrt(np.clip(frame / np.float32(header[name]), 0, 1))
        to[:] = np.rint(255 * np.moveaxis(root, 2, 0))
    planes[-1] = alpha
    head = json.dumps(header).encode()
    return gzip.compress(len(head).to_bytes(4, "little") + head + planes.tobytes(), _LEVEL, mtime=0)
