"""A matte as layers that other tools read: EXR with the official library, and 16-bit PNG.

Every layer has the frame's size. All values are linear light or plain numbers; a PNG's are clipped to 0 to 1.

=================  ===========================================================================================
``S``, ``rho``     Offset and factor of ``C = S + X (rho T L)``: R, G and B
``alpha``          1 where the pixel was recovered, 0 where the capture's mask left it out
``confidence``     ``1 / (1 + e / 0.01)``, e the error to expect of a composite there
``stmap.exr``      R and G: where the pixel's heaviest lobe lies; B: 1 where there is one, else 0. 32 bits
``all.exr``        All of it, and the lobes of each pixel
=================  ===========================================================================================

``all.exr`` has the channels ``R``, ``G``, ``B``, ``A``: the glass before a white monitor, so that whatever opens an
EXR shows something, and alpha; ``S.R`` to ``S.B``, ``rho.R`` to ``rho.B``, ``confidence.Y``; and of each lobe, from
``lobe0``, the heaviest, on, ``lobe0.u``, ``.v``, ``.weight.R`` to ``.weight.B``, ``.sigma_u``, ``.sigma_v``,
``.theta``, see :func:`~workflows.recovery.lobe_table.ranked_lobes`. A pixel of fewer lobes has zeros in the others. One
part with names of the form ``layer.channel`` is what compositors show as layers; of several parts some read the first
alone. Places (u and v) have 32 bits, for half a float is too coarse for a monitor's pixels; all else has 16.

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

from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.images import float_formats, integer_formats
from workflows.mattes.lobes import block_lobes
from workflows.recovery.lobe_table import FIELDS

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


def confidence(matte: Matte) -> NDArray[np.float32]:
    """How far each pixel of a matte can be trusted.

    Returns
    -------
    (height, width) float32
        ``1 / (1 + e / 0.01)``, e the expected error of a composite in camera units: 1/2 at 40 dB. 0 where nothing was
        recovered.
    """
    trusted = 1 / (1 + matte.layer("error") / np.float32(0.01))
    return np.where(matte.layer("recovered"), trusted, 0).astype(np.float32)


def layer(matte: Matte, name: str) -> NDArray[np.float32]:
    """A layer.

    Parameters
    ----------
    matte : Matte
    name : str
        One of `NAMES`.

    Returns
    -------
    (height, width, 3 or 1) float32

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    if name == "confidence":
        return confidence(matte)[..., np.newaxis]
    values = matte.layer("recovered" if name == "alpha" else name)
    return values.reshape(matte.height, matte.width, -1).astype(np.float32)


def png(matte: Matte, name: str) -> bytes:
    """A layer as a 16-bit PNG, its values linear and clipped to 0 to 1."""
    return integer_formats.encode_png(integer_formats.to_integers(layer(matte, name), np.dtype(np.uint16)))


def exr(matte: Matte, name: str) -> bytes:
    """A layer as an EXR of 32 bits: R, G and B, or Y."""
    values = layer(matte, name)
    names = "RGB" if values.shape[2] == 3 else "Y"
    return _encode(matte, {channel: values[..., c] for c, channel in enumerate(names)})


def stmap(matte: Matte) -> bytes:
    """Where the heaviest lobe of each pixel lies, as an EXR of 32 bits: u, v, and whether there is one."""
    planes = {channel: np.zeros((matte.height, matte.width), np.float32) for channel in "RGB"}
    for row, column in np.ndindex(matte.block_rows, matte.block_columns):
        lobes = block_lobes(matte, matte.read(row, column), LOBES)[..., 0, :]
        at = matte.span(row, column)
        planes["R"][at], planes["G"][at] = lobes[..., 0], lobes[..., 1]
        planes["B"][at] = lobes[..., 2:5].any(axis=-1)
    return _encode(matte, planes)


def everything(matte: Matte, lobes: int = LOBES) -> bytes:
    """All layers and the lobes in one EXR.

    Parameters
    ----------
    matte : Matte
    lobes : int
        Of a pixel; more are merged into these.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    frame = matte.height, matte.width
    half = ["R", "G", "B", "A", *(f"{name}.{c}" for name in ("S", "rho") for c in "RGB"), "confidence.Y"]
    planes: Planes = {name: np.zeros(frame, np.float16) for name in half}
    for k in range(lobes):
        for name in FIELDS:
            planes[f"lobe{k}.{name}"] = np.zeros(frame, np.float32 if name in ("u", "v") else np.float16)
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)
    planes["confidence.Y"][:] = confidence(matte)
    for row, column in np.ndindex(matte.block_rows, matte.block_columns):
        block, at = matte.read(row, column), matte.span(row, column)
        ranked = block_lobes(matte, block, lobes)
        white = block.S + (block.rho * ranked[..., 2:5].sum(axis=-2)) @ crosstalk.T
        for c, channel in enumerate("RGB"):
            planes[channel][at] = white[..., c]
            planes[f"S.{channel}"][at], planes[f"rho.{channel}"][at] = block.S[..., c], block.rho[..., c]
        planes["A"][at] = block.recovered
        for k in range(lobes):
            for f, name in enumerate(FIELDS):
                planes[f"lobe{k}.{name}"][at] = ranked[..., k, f]
    return _encode(matte, planes)


def bytes_of_everything(width: int, height: int, lobes: int) -> int:
    """Bytes that `everything` holds of a frame's values."""
    return width * height * (11 * 2 + lobes * (2 * 4 + 6 * 2))


def _encode(matte: Matte, planes: Planes) -> bytes:
    header = {
        "crosstalk": np.array(matte.attributes["crosstalk"], np.float32),
        "monitor": tuple(matte.attributes["monitor"]),
        "comments": _COMMENTS,
    }
    return float_formats.encode_exr(planes, header)
