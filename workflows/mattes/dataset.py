"""A matte as an xarray Dataset, of dask arrays that read a block when it is needed.

=====================================  =================================================================
``S``, ``rho`` (y, x, channel)         Offset and factor of ``C = S + X (rho T L)``
``alpha`` (y, x)                       1 where the pixel was recovered, 0 where it was left out
``confidence`` (y, x)                  ``1 / (1 + e / 0.01)``, e the error to expect of a composite there
``u``, ``v`` (y, x, lobe)              Where a lobe lies on the monitor, 0 to 1 from its bottom left
``weight`` (y, x, lobe, channel)       Its share of a channel's light
``sigma_u``, ``sigma_v`` (y, x, lobe)  Standard deviations along its axes, in widths of the monitor
``theta`` (y, x, lobe)                 From u to the axis of ``sigma_u``, in radians counter-clockwise
=====================================  =================================================================

All are float32, in linear light or plain numbers. A chunk is a block of the matte. The attributes are ``monitor``, its
width and height in pixels; ``crosstalk``, X, its rows one after another; ``columns`` and ``rows``, the grid of T; and,
if they were measured, the ``contrast``, ``read``, ``shot`` and ``share`` of `workflows.recovery.interval.Interval` one
after another as ``interval``: how far a composite may be from the truth. `workflows.mattes.layers` says how a composite
is made of them.
"""

import operator
from functools import partial
from typing import Any, Protocol

import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from storage.layout.mattes import Block
from workflows.mattes.layers import LOBES, MOST_LOBES, confidence_of
from workflows.mattes.lobes import Gridded, block_lobes
from workflows.recovery.clusters.lobe_table import FIELDS
from workflows.recovery.interval import Interval

_WEIGHT = FIELDS.index("weight.R")
_CHANNELS = 3
_ABOUT = {
    "S": "light that the object adds",
    "rho": "share of the monitor's light that arrives",
    "alpha": "whether the pixel was recovered",
    "confidence": "1 / (1 + error to expect / 0.01)",
    "u": "centre of the lobe, 0 to 1 from the monitor's left",
    "v": "centre of the lobe, 0 to 1 from the monitor's bottom",
    "weight": "share of a channel's light",
    "sigma_u": "standard deviation, in widths of the monitor",
    "sigma_v": "standard deviation across sigma_u, in widths of the monitor",
    "theta": "angle from u to the axis of sigma_u, in radians counter-clockwise",
}


class Source(Gridded, Protocol):
    """A matte that is read block by block, from the store or from an archive."""

    def chunk(self, name: str, row: int, column: int) -> NDArray[Any]: ...

    def read(self, row: int, column: int) -> Block: ...


def dataset_of(matte: Source, lobes: int = LOBES) -> xr.Dataset:
    """A matte as a Dataset. Nothing is read but what `matte` knows already.

    Parameters
    ----------
    matte : Source
    lobes : int
        Of a pixel, the heaviest first; more are merged into these.

    Raises
    ------
    TypeError
        If `lobes` is not a whole number.
    ValueError
        If it is not from 1 to 8.
    """
    lobes = operator.index(lobes)
    if not 1 <= lobes <= MOST_LOBES:
        raise ValueError(f"lobes is {lobes}: ask for 1 to {MOST_LOBES}")
    edge = matte.attributes["block"]
    frame = tuple(_chunks(matte.attributes[name], edge) for name in ("height", "width"))

    def blocks(read: Any, *shape: int) -> da.Array:
        chunks = (*frame, *((n,) for n in shape))
        meta = np.empty((0,) * len(chunks), np.float32)
        return da.map_blocks(read, chunks=chunks, dtype=np.float32, meta=meta)

    table = blocks(partial(_lobes, matte, lobes), lobes, len(FIELDS))
    of_lobe = {name: table[..., k] for k, name in enumerate(FIELDS) if "." not in name}
    variables = {
        **{
            name: (("y", "x", "channel"), blocks(partial(_layer, matte, name), _CHANNELS))
            for name in ("S", "rho")
        },
        "alpha": (("y", "x"), blocks(partial(_layer, matte, "recovered"))),
        "confidence": (("y", "x"), blocks(partial(_confidence, matte))),
        **{name: (("y", "x", "lobe"), values) for name, values in of_lobe.items()},
        "weight": (("y", "x", "lobe", "channel"), table[..., _WEIGHT : _WEIGHT + _CHANNELS]),
    }
    return xr.Dataset(
        {name: (dims, values, {"long_name": _ABOUT[name]}) for name, (dims, values) in variables.items()},
        {"channel": list("RGB")},
        {
            "monitor": list(matte.attributes["monitor"]),
            "crosstalk": np.ravel(matte.attributes["crosstalk"]).tolist(),
            "columns": matte.columns,
            "rows": matte.rows,
            **_interval(matte),
        },
    )


def _interval(matte: Source) -> dict[str, list[float]]:
    found = matte.attributes.get("interval")
    return {"interval": list(Interval(**found))} if found else {}


def _chunks(size: int, edge: int) -> tuple[int, ...]:
    return tuple(min(edge, size - first) for first in range(0, size, edge))


def _layer(matte: Source, name: str, *, block_id: tuple[int, ...]) -> NDArray[np.float32]:
    return matte.chunk(name, *block_id[:2]).astype(np.float32)


def _confidence(matte: Source, *, block_id: tuple[int, ...]) -> NDArray[np.float32]:
    return confidence_of(matte.chunk("error", *block_id), matte.chunk("recovered", *block_id))


def _lobes(matte: Source, lobes: int, *, block_id: tuple[int, ...]) -> NDArray[np.float32]:
    return block_lobes(matte, matte.read(*block_id[:2]), lobes)
