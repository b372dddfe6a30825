"""The transport of single pixels of mattes over HTTP: where their light comes from."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

from fastapi import Query, Request, Response
from pydantic import BaseModel
from pydantic_core import to_json

from services.api.context import Context, OwnerContext
from services.api.http.responses import bytes_response
from services.api.http.router import Router
from services.api.http.types import Colour, Pair
from services.api.mattes.layers import BLOCK_BYTES, OF_LOBES
from storage.layout.mattes import Matte
from storage.records import mattes
from workflows.mattes.layers import LOBES, MOST_LOBES
from workflows.mattes.pixel import Pixel, bytes_of_pixel, look_into
from workflows.mattes.pixel_picture import picture

router = Router(tags=["mattes"])
MOST_CELLS = 10_000
"""Cells of one answer, some 2 MB."""
Lobes = Annotated[int, Query(ge=1, le=MOST_LOBES, description=OF_LOBES)]
Cells = Annotated[int, Query(ge=0, le=MOST_CELLS, description="The most cells to list.")]
Skip = Annotated[int, Query(ge=0, le=1 << 32, description="Cells to leave out, the heaviest first.")]
X = Annotated[int, Query(description="The pixel's column, from 0 at the left.")]
Y = Annotated[int, Query(description="The pixel's row, from 0 at the top.")]


class Cell(BaseModel):
    """A cell of the monitor that light comes from. Its centre is from 0 to 1, with v up. If ``level`` is not 0, it is
    the middle of a smooth bump three times as large."""

    u: float
    v: float
    width: float
    height: float
    level: int
    weight: Colour


class Lobe(BaseModel):
    """A Gaussian: its centre, as of a cell; the standard deviations along its axes, in widths of the monitor; and the
    angle of its first axis, in radians counter-clockwise from the u axis."""

    u: float
    v: float
    weight: Colour
    sigma_u: float
    sigma_v: float
    theta: float


class Transport(BaseModel):
    """Where the light of a pixel comes from: cells and lobes, heaviest first; none if the pixel was not recovered."""

    x: int
    y: int
    recovered: bool
    S: Colour
    rho: Colour
    monitor: Pair
    cells: list[Cell]
    cells_total: int
    """Of the pixel; `cells` may have a part of them."""
    lobes: list[Lobe]


@router.get("/mattes/{id}/transport", response_model=Transport)
async def get_transport(
    context: OwnerContext,
    id: str,
    x: X,
    y: Y,
    request: Request,
    lobes: Lobes = LOBES,
    cells: Cells = MOST_CELLS,
    skip: Skip = 0,
) -> Response:
    """Where the light of a pixel comes from: cells of the monitor with their weights by channel, and lobes."""
    return await _look(
        context,
        request,
        id,
        (x, y),
        lobes,
        lambda pixel: bytes_response(to_json(_describe(pixel, cells, skip)), "application/json"),
    )


@router.get(
    "/mattes/{id}/transport.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The picture"}},
)
async def get_transport_picture(
    context: OwnerContext, id: str, x: X, y: Y, request: Request, lobes: Lobes = LOBES
) -> Response:
    """The transport of a pixel as a picture: the monitor, a close-up with the lobes as ellipses, and each channel."""
    return await _look(
        context,
        request,
        id,
        (x, y),
        lobes,
        lambda pixel: bytes_response(picture(pixel), "image/png"),
    )


async def _look(
    context: Context,
    request: Request,
    id: str,
    place: tuple[int, int],
    lobes: int,
    answer: Callable[[Pixel], Response],
) -> Response:
    """Look into a pixel as soon as there is memory for it, and answer with something of it."""

    def measure() -> tuple[Matte, int]:
        with context.stored(mattes.get_ready, id):
            matte = context.cache.matte(id)
            return matte, BLOCK_BYTES + bytes_of_pixel(matte, *place)

    def look() -> Response:
        with context.stored(mattes.get_ready, id):
            return answer(look_into(matte, *place, lobes))

    matte, size = await context.call(measure)
    return await context.compute(request, context.shares.memory, look, size)


def _describe(pixel: Pixel, cells: int, skip: int) -> dict[str, Any]:
    """The fields of a `Transport` with some of the cells.

    As plain values: 10,000 cells as models would keep the event loop waiting several times as long.
    """
    part = slice(skip, skip + cells)
    shown = replace(pixel, node=pixel.node[part], weight=pixel.weight[part])
    return {
        "x": pixel.x,
        "y": pixel.y,
        "recovered": pixel.recovered,
        "S": pixel.S.tolist(),
        "rho": pixel.rho.tolist(),
        "monitor": pixel.monitor,
        "cells": [
            {"u": u, "v": v, "width": width, "height": height, "level": level, "weight": weight}
            for (u, v, width, height), level, weight in zip(
                shown.cells.tolist(), shown.levels.tolist(), shown.weight.tolist(), strict=True
            )
        ],
        "cells_total": len(pixel.node),
        "lobes": [
            {"u": u, "v": v, "weight": [r, g, b], "sigma_u": sigma_u, "sigma_v": sigma_v, "theta": theta}
            for u, v, r, g, b, sigma_u, sigma_v, theta in pixel.lobes.tolist()
        ],
    }
