"""Layers of mattes for other programs, and the transport of single pixels, over HTTP."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import IO, Annotated, Any

from fastapi import Query, Request, Response
from pydantic import BaseModel
from pydantic_core import to_json

from services.api.context import Context, OwnerContext
from services.api.http.responses import VERSION, bytes_response, etag_matches, file_response
from services.api.http.router import Router
from services.api.http.types import Colour, Pair
from services.api.mattes import live_module
from services.api.mattes.progress import Progress, open_whole_frame, while_there
from storage.errors import InvalidInput, NotFound
from storage.layout import mattes as stored_mattes
from storage.records import mattes
from workflows.composite.backdrops.around import Plate, plate_of
from workflows.composite.live import nodes
from workflows.composite.live.encode import bytes_of_live
from workflows.composite.live.nodes.exr import LOOKUPS, bytes_of_lookups
from workflows.mattes import layers
from workflows.mattes.pixel import Pixel, bytes_of_pixel, look_into
from workflows.mattes.pixel_picture import picture
from workflows.threads import CORES

router = Router(tags=["mattes"])
MOST_BYTES = 1 << 30
"""The most that a file of lobes or lookups may have before it is compressed: it waits in a temporary file."""
MEDIA_TYPES = {
    "png": "image/png",
    "exr": "image/x-exr",
    "py": "text/x-python",
    "nk": "text/plain",
    "html": "text/html",
    "js": "text/javascript",
    "live": "application/octet-stream",
}


def _stmap(matte: stored_mattes.Matte, file: IO[bytes], plate: Plate | None = None) -> None:
    layers.stmap(matte, file, plate and plate.place)


FILES: dict[str, Callable[..., None]] = {
    f"{name}.{kind}": lambda matte, file, name=name, write=write: write(matte, name, file)
    for name in layers.NAMES
    for kind, write in (("png", layers.png), ("exr", layers.exr))
} | {"stmap.exr": _stmap}
ALL = "all.exr"
NODES = nodes.FILES | live_module.FILES
OF_PLATE = ("stmap.exr", "blender.py", "nuke.nk", "nuke_stmap.nk")
"""The files that can take a plate of the frame."""
OF_LOBES = "The most lobes of a pixel; further ones are merged into these."
AS_FIT = "By default {}, and of a large frame as many as take 1 GiB before they are compressed."
Lobes = Annotated[int, Query(ge=1, le=layers.MOST_LOBES, description=OF_LOBES)]
FittingLobes = Annotated[
    int | None,
    Query(ge=1, le=layers.MOST_LOBES, description=f"{OF_LOBES} {AS_FIT.format(layers.LOBES)}"),
]
FittingLookups = Annotated[
    int | None,
    Query(
        ge=1,
        le=LOOKUPS,
        description="The most lookups of a pixel in the files of a node; further cells are merged into these. "
        + AS_FIT.format(LOOKUPS),
    ),
]
OverPlate = Annotated[
    bool,
    Query(
        description=f"Make {', '.join(OF_PLATE[:-1])} or {OF_PLATE[-1]} for a plate of the frame, which the glass goes "
        "over, in place of a picture that is stretched over the monitor. For mattes that were recovered with `cut_out`."
    ),
]
MOST_CELLS = 10_000
"""Cells of one answer, some 2 MB."""
LOOK_BYTES = 32 << 20
"""What an answer takes beside a pixel, or beside a layer's values: a block of the matte, above all."""
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


@router.get(
    "/mattes/{id}/layers/{file}",
    response_class=Response,
    responses={200: {"content": {kind: {} for kind in MEDIA_TYPES.values()}, "description": "The layer"}},
)
async def get_layer(
    context: OwnerContext,
    id: str,
    file: str,
    request: Request,
    lobes: FittingLobes = None,
    lookups: FittingLookups = None,
    plate: OverPlate = False,
) -> Response:
    """A layer: `S`, `rho`, `alpha` or `confidence`, as `.png` (16 bits, linear, clipped to 0 to 1) or `.exr`;
    `stmap.exr`; `all.exr`, all layers with the lobes of each pixel; or `lookups.exr`, for a node that draws the glass,
    and the file that makes this node: `blender.py`, `nuke.nk` or `nuke_stmap.nk`. `envmatte.js` is a module of
    JavaScript that draws `matte.live`, and `glass.html` a page that uses it.

    If the matte is still being recovered, they are those of its preview, which is smaller.
    """
    if file not in (known := [*FILES, ALL, *NODES]):
        raise NotFound(f"there is no layer {file}; the layers are {', '.join(known)}")
    if plate and file not in OF_PLATE:
        raise InvalidInput(f"{file} takes no plate: only {', '.join(OF_PLATE)} do", field="plate")

    progress, matte = await context.call(open_whole_frame, context, id)
    lobes_each = lobes or _most_that_fit(layers.bytes_of_everything, matte, layers.LOBES)
    lookups_each = lookups or _most_that_fit(bytes_of_lookups, matte, LOOKUPS)

    def headers_of(progress: Progress) -> dict[str, str]:
        # Neither a matte that is ready nor a preview ever changes; what is made of them may with an upgrade.
        tag = f'"{VERSION}-{progress.whole_frame}-{file}-{lobes_each}-{lookups_each}-{plate}"'
        headers = progress.headers | {"ETag": tag}
        # Saved and not shown: here it would be a page of the service.
        return headers | ({"Content-Disposition": "attachment"} if file.endswith(".html") else {})

    headers = headers_of(progress)
    if etag_matches(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    of_lobes = layers.bytes_of_everything, lobes_each, "lobes"
    of_lookups = bytes_of_lookups, lookups_each, "lookups"
    bytes_of, number, name = of_lookups if file in nodes.FILES else of_lobes
    size = bytes_of(matte.width, matte.height, number)
    # The live form and single layers of any frame are small enough.
    if (file == ALL or file in nodes.FILES) and size > MOST_BYTES:
        raise InvalidInput(
            f"{file} with {number} {name} takes {size} bytes, and the limit is {MOST_BYTES}: ask for fewer {name}, or "
            "for the layers one by one",
            field=name,
            limit=MOST_BYTES,
        )
    kind = file.rpartition(".")[2]

    def write(found: stored_mattes.Matte, given: dict[str, Any], target: IO[bytes]) -> None:
        if file in NODES:
            NODES[file](found, target, lookups_each, **given)
        elif file == ALL:
            layers.everything(found, target, lobes_each)
        else:
            FILES[file](found, target, **given)

    def encode(now: Progress) -> Response:
        found = context.cache.matte(now.whole_frame)
        given = {"plate": plate_of(context.cache.matte(id))} if plate else {}
        return file_response(partial(write, found, given), MEDIA_TYPES[kind], headers_of(now))

    work = partial(while_there, context, progress, encode)
    memory = LOOK_BYTES + layers.bytes_of_band(matte, lobes_each)
    if file in NODES:
        band = bytes_of_lookups(matte.width, matte.block, lookups_each)
        memory = CORES * LOOK_BYTES + (bytes_of_live(matte) if file == live_module.LIVE else band)
    return await context.compute(request, context.shares.layers, work, memory=memory)


def _most_that_fit(bytes_of: Callable[[int, int, int], int], matte: stored_mattes.Matte, most: int) -> int:
    """How many lobes or lookups of a pixel a file has room for: at most `most`, and one at least."""
    numbers = range(most, 1, -1)
    return next((n for n in numbers if bytes_of(matte.width, matte.height, n) <= MOST_BYTES), 1)


@router.get("/mattes/{id}/transport", response_model=Transport)
async def get_transport(
    context: OwnerContext,
    id: str,
    x: X,
    y: Y,
    request: Request,
    lobes: Lobes = layers.LOBES,
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
    context: OwnerContext, id: str, x: X, y: Y, request: Request, lobes: Lobes = layers.LOBES
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

    def measure() -> tuple[stored_mattes.Matte, int]:
        with context.stored(mattes.get_ready, id):
            matte = context.cache.matte(id)
            return matte, LOOK_BYTES + bytes_of_pixel(matte, *place)

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
