"""A matte as layers that other tools read, as EXR and 16-bit PNG.

They are made in bands, a row of blocks high, so that a large one takes little memory and can end between two of them.
Light is linear with the primaries of Rec. 709, as the header's ``chromaticities`` say.

Every layer has the frame's size. All values are linear light or plain numbers; a PNG's are clipped to 0 to 1.

=================  ===========================================================================================
``S``, ``rho``     Offset and factor of ``C = S + X (rho T L)``: R, G and B
``alpha``          1 where the pixel was recovered, 0 where it was left out: by the mask, or as no part of the object
``confidence``     ``1 / (1 + e / 0.01)``, e the error to expect of a composite there
``stmap.exr``      R and G: where the pixel's heaviest lobe lies, on the monitor or, if so asked, on a plate of the
                   frame; B: 1 where there is one, else 0. 32 bits
``all.exr``        All of it, and the lobes of each pixel
=================  ===========================================================================================

``all.exr`` has the channels ``R``, ``G``, ``B``, ``A``: the glass before a white monitor, so that whatever opens an
EXR shows something, and alpha; ``S.R`` to ``S.B``, ``rho.R`` to ``rho.B``, ``confidence.Y``; and of each lobe, from
``lobe0``, the heaviest, on, ``lobe0.u``, ``.v``, ``.weight.R`` to ``.weight.B``, ``.sigma_u``, ``.sigma_v``,
``.theta``, see :func:`~workflows.recovery.clusters.lobe_table.ranked_lobes`. A pixel of fewer lobes has zeros in the
others. One part with names of the form ``layer.channel`` is what compositors show as layers; of several parts some read
the first alone. Places (u and v) have 32 bits, for half a float is too coarse for a monitor's pixels; all else has 16.

Positions are those of an STMap: 0 to 1 over the backdrop, the origin at its bottom left, and the centre of column x of
a backdrop w wide at ``(x + 0.5) / w``. The map takes the heaviest lobe, not the mean of the row: between what a pixel
sees through the glass and what it sees mirrored there is nothing.

With the channels of a lobe k called u, v, weight and so on, L the backdrop in linear light, stretched to the monitor's
shape, and X the header's ``crosstalk`` (row: the camera's channel, column: the monitor's; no more than the unit
matrix for a camera that tells the colours apart), the glass before the backdrop is::

    C = S + X (rho * sum over k of weight_k * (L blurred by lobe k's ellipse)(u_k, v_k))

In a node compositor:

1. Bring the backdrop to linear light and to the aspect of the header's ``monitor``.
2. For each lobe: look the backdrop up at (u, v) with an STMap node, blurred there by ``sigma_u`` and ``sigma_v`` times
   the backdrop's width in pixels (a blur that varies by pixel, or the two of a few evenly blurred copies that come
   nearest); and multiply it by ``lobe0.weight``.
3. Add the lobes up, multiply by ``rho``, apply the crosstalk with a colour matrix, and add ``S``.
4. Copy ``A`` in as alpha, and put it over the plate.

Step 2 for ``lobe0`` alone, without weight, is the picture a plain STMap gives. The sigmas include the extent of the
backdrop's own pixels, a variance of 1/12 of a pixel squared along each axis: a filter over its pixels leaves that out.
"""

from collections.abc import Iterator
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Block, Matte
from workflows.images.float_formats import REC_709
from workflows.images.integer_formats import to_integers
from workflows.images.writers.exr import Types, write_exr
from workflows.images.writers.png import write_png
from workflows.interruption import checkpoint
from workflows.mattes.lobes import block_lobes
from workflows.recovery.clusters.lobe_table import FIELDS

NAMES = ("S", "rho", "alpha", "confidence")
"""The layers that are files of their own, as PNG and as EXR."""
LOBES, MOST_LOBES = 4, 8
"""Lobes of a pixel unless another number is asked for, and at most."""
Planes = dict[str, NDArray[Any]]
_COMMENTS = (
    "C = S + crosstalk (rho * sum_k lobe_k.weight * blur(L, sigma_u, sigma_v, theta)(u, v)). u, v: 0 to 1 over the "
    "backdrop L, from its bottom left. sigma: in widths of the monitor. "
    "theta: radians counter-clockwise from u. Linear light."
)


def confidence(matte: Matte, rows: slice = slice(None)) -> NDArray[np.float32]:
    """How far each pixel of a matte, or of some of its rows, can be trusted.

    Returns
    -------
    (height, width) float32
        ``1 / (1 + e / 0.01)``, e the expected error of a composite in camera units: 1/2 at 40 dB. 0 where nothing was
        recovered.
    """
    return confidence_of(matte.layer("error", rows), matte.layer("recovered", rows))


def layer(matte: Matte, name: str, rows: slice = slice(None)) -> NDArray[np.float32]:
    """A layer, or some rows of it.

    Parameters
    ----------
    matte : Matte
    name : str
        One of `NAMES`.
    rows : slice

    Returns
    -------
    (height, width, 3 or 1) float32

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    if name == "confidence":
        return confidence(matte, rows)[..., np.newaxis]
    values = matte.layer("recovered" if name == "alpha" else name, rows)
    return np.atleast_3d(values).astype(np.float32, copy=False)


def png(matte: Matte, name: str, file: IO[bytes]) -> None:
    """Write a layer as a 16-bit PNG, its values linear and clipped to 0 to 1."""
    bands = (to_integers(layer(matte, name, rows), np.dtype(np.uint16)) for rows in _bands(matte))
    write_png(file, matte.width, matte.height, len(_channels(name)), np.uint16, bands)


def exr(matte: Matte, name: str, file: IO[bytes]) -> None:
    """Write a layer as an EXR of 32 bits: R, G and B, or Y."""
    names = _channels(name)
    bands = (
        {channel: values[..., c] for c, channel in enumerate(names)}
        for values in (layer(matte, name, rows) for rows in _bands(matte))
    )
    _write(file, matte, dict.fromkeys(names, np.float32), bands)


def stmap(matte: Matte, file: IO[bytes], place: NDArray[np.float64] | None = None) -> None:
    """Write where the heaviest lobe of each pixel lies as an EXR of 32 bits: u, v, and whether there is one.

    Parameters
    ----------
    matte : Matte
    file : IO[bytes]
    place : (3, 3) float64, optional
        The homography from the monitor to what is looked up in its place, both from 0 to 1 across and down.
    """

    def bands() -> Iterator[Planes]:
        for row, rows in enumerate(_bands(matte)):
            planes = {name: np.zeros((rows.stop - rows.start, matte.width), np.float32) for name in "RGB"}
            for block, columns in _blocks(matte, row):
                lobes = block_lobes(matte, block, LOBES)[..., 0, :]
                there = lobes[..., 2:5].any(axis=-1)
                seen = lobes[..., :2] if place is None else _moved(lobes[..., :2], place)
                planes["R"][:, columns], planes["G"][:, columns] = np.moveaxis(seen, -1, 0) * there
                planes["B"][:, columns] = there
            yield planes

    _write(file, matte, dict.fromkeys("RGB", np.float32), bands())


def _moved(places: NDArray[np.float32], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places u, v (..., 2) by a homography of x and y, where y goes down."""
    seen = np.stack([places[..., 0], 1 - places[..., 1], np.ones(places.shape[:-1])], axis=-1) @ place.T
    x, y = np.moveaxis(seen[..., :2] / seen[..., 2:], -1, 0)
    return np.stack([x, 1 - y], axis=-1)


def everything(matte: Matte, file: IO[bytes], lobes: int = LOBES) -> None:
    """Write all layers and the lobes as one EXR.

    Parameters
    ----------
    matte : Matte
    file : IO[bytes]
    lobes : int
        Of a pixel; more are merged into these.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    half = ["R", "G", "B", "A", *(f"{name}.{c}" for name in ("S", "rho") for c in "RGB"), "confidence.Y"]
    types: dict[str, type[np.float16] | type[np.float32]] = dict.fromkeys(half, np.float16)
    for k in range(lobes):
        types |= {f"lobe{k}.{name}": np.float32 if name in ("u", "v") else np.float16 for name in FIELDS}
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)

    def bands() -> Iterator[Planes]:
        for row, rows in enumerate(_bands(matte)):
            shape = rows.stop - rows.start, matte.width
            planes: Planes = {name: np.zeros(shape, kind) for name, kind in types.items()}
            for block, columns in _blocks(matte, row):
                at = slice(None), columns
                ranked = block_lobes(matte, block, lobes)
                white = block.S + (block.rho * ranked[..., 2:5].sum(axis=-2)) @ crosstalk.T
                for c, channel in enumerate("RGB"):
                    planes[channel][at] = white[..., c]
                    planes[f"S.{channel}"][at] = block.S[..., c]
                    planes[f"rho.{channel}"][at] = block.rho[..., c]
                planes["A"][at] = block.recovered
                planes["confidence.Y"][at] = confidence_of(block.error, block.recovered)
                for k in range(lobes):
                    for f, name in enumerate(FIELDS):
                        planes[f"lobe{k}.{name}"][at] = ranked[..., k, f]
            yield planes

    _write(file, matte, types, bands())


def bytes_of_band(matte: Matte, lobes: int) -> int:
    """Bytes that writing a file takes at most: a band of `everything`."""
    return bytes_of_everything(matte.width, matte.block, lobes)


def bytes_of_everything(width: int, height: int, lobes: int) -> int:
    """Bytes of a frame's values in the EXR of `everything`, before they are compressed."""
    return width * height * (11 * 2 + lobes * (2 * 4 + 6 * 2))


def confidence_of(error: NDArray[np.float32], recovered: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The confidence of pixels from the arrays of a matte."""
    return np.where(recovered, 1 / (1 + error / np.float32(0.01)), np.float32(0))


def _channels(name: str) -> str:
    return "RGB" if name in ("S", "rho") else "Y"


def _bands(matte: Matte) -> Iterator[slice]:
    """The rows of each row of blocks, as long as somebody wants them."""
    for row in range(matte.block_rows):
        checkpoint()
        yield matte.span(row, 0)[0]


def _blocks(matte: Matte, row: int) -> Iterator[tuple[Block, slice]]:
    """The blocks of a row, and their columns."""
    for column in range(matte.block_columns):
        checkpoint()
        yield matte.read(row, column), matte.span(row, column)[1]


def _write(file: IO[bytes], matte: Matte, types: Types, bands: Iterator[Planes]) -> None:
    header = {
        "chromaticities": REC_709,
        "crosstalk": np.array(matte.attributes["crosstalk"], np.float32),
        "monitor": tuple(matte.attributes["monitor"]),
        "comments": _COMMENTS,
    }
    write_exr(file, matte.width, matte.height, types, bands, header)
