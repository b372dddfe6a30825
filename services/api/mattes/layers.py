"""Layers of mattes for other programs, over HTTP."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import IO, Annotated

from fastapi import Query, Request, Response

from services.api.context import OwnerContext
from services.api.http.responses import VERSION, etag_matches, file_response
from services.api.http.router import Router
from services.api.mattes import live_module
from services.api.mattes.progress import Progress, open_whole_frame, while_there
from storage.errors import InvalidInput, NotFound
from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import Plate, plate_of
from workflows.composite.live import nodes
from workflows.composite.live.encode import bytes_of_live
from workflows.composite.live.nodes.exr import LOOKUPS, bytes_of_lookups
from workflows.mattes import layers
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


def _stmap(matte: Matte, file: IO[bytes], plate: Plate | None = None) -> None:
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
AS_FIT = "By default {}, and of a large frame as many as take 1 GiB before they are compressed."
OF_LOBES = "The most lobes of a pixel; further ones are merged into these."
Lobes = Annotated[
    int | None,
    Query(ge=1, le=layers.MOST_LOBES, description=f"{OF_LOBES} {AS_FIT.format(layers.LOBES)}"),
]
Lookups = Annotated[
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
BLOCK_BYTES = 32 << 20
"""What an answer takes beside a pixel, or beside a layer's values: a block of the matte, above all."""


@dataclass(frozen=True)
class LayerFile:
    """A file that a request asks for, made of what shows the whole frame of a matte.

    Attributes
    ----------
    name : str
    matte : Matte
        What shows the whole frame: the matte, or its preview.
    lobes, lookups : int
        The most of a pixel.
    for_plate : bool
        Whether it is for a plate of the frame.
    """

    name: str
    matte: Matte
    lobes: int
    lookups: int
    for_plate: bool

    @property
    def media_type(self) -> str:
        """By the end of its name."""
        return MEDIA_TYPES[self.name.rpartition(".")[2]]

    def headers(self, progress: Progress) -> dict[str, str]:
        """Of the answer; its entity tag names all that the file depends on."""
        # Neither a matte that is ready nor a preview ever changes; what is made of them may with an upgrade.
        made = f"{self.name}-{self.lobes}-{self.lookups}-{self.for_plate}"
        headers = progress.headers | {"ETag": f'"{VERSION}-{progress.whole_frame}-{made}"'}
        # Saved and not shown: here it would be a page of the service.
        return headers | ({"Content-Disposition": "attachment"} if self.name.endswith(".html") else {})

    def check_size(self) -> None:
        """Check that it is small enough: the live form and single layers of any frame are.

        Raises
        ------
        InvalidInput
        """
        width, height = self.matte.width, self.matte.height
        if self.name == ALL:
            number, what, size = self.lobes, "lobes", layers.bytes_of_everything(width, height, self.lobes)
        elif self.name in nodes.FILES:
            number, what, size = self.lookups, "lookups", bytes_of_lookups(width, height, self.lookups)
        else:
            return
        if size > MOST_BYTES:
            raise InvalidInput(
                f"{self.name} with {number} {what} takes {size} bytes, and the limit is {MOST_BYTES}: ask for fewer "
                f"{what}, or for the layers one by one",
                field=what,
                limit=MOST_BYTES,
            )

    @property
    def memory(self) -> int:
        """Bytes that writing it takes at most."""
        if self.name == live_module.LIVE:
            return CORES * BLOCK_BYTES + bytes_of_live(self.matte)
        if self.name in NODES:
            return CORES * BLOCK_BYTES + bytes_of_lookups(self.matte.width, self.matte.block, self.lookups)
        return BLOCK_BYTES + layers.bytes_of_band(self.matte, self.lobes)

    def write(self, matte: Matte, plate: Plate | None, target: IO[bytes]) -> None:
        """Write it, of the matte as it is now."""
        given = {} if plate is None else {"plate": plate}
        if self.name in NODES:
            NODES[self.name](matte, target, self.lookups, **given)
        elif self.name == ALL:
            layers.everything(matte, target, self.lobes)
        else:
            FILES[self.name](matte, target, **given)


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
    lobes: Lobes = None,
    lookups: Lookups = None,
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
    asked = LayerFile(
        file,
        matte,
        lobes or _most_that_fit(layers.bytes_of_everything, matte, layers.LOBES),
        lookups or _most_that_fit(bytes_of_lookups, matte, LOOKUPS),
        plate,
    )
    headers = asked.headers(progress)
    if etag_matches(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    asked.check_size()

    def encode(now: Progress) -> Response:
        found = context.cache.matte(now.whole_frame)
        over = plate_of(context.cache.matte(id)) if plate else None
        return file_response(partial(asked.write, found, over), asked.media_type, asked.headers(now))

    work = partial(while_there, context, progress, encode)
    return await context.compute(request, context.shares.layers, work, memory=asked.memory)


def _most_that_fit(bytes_of: Callable[[int, int, int], int], matte: Matte, most: int) -> int:
    """How many lobes or lookups of a pixel a file has room for: at most `most`, and one at least."""
    numbers = range(most, 1, -1)
    return next((n for n in numbers if bytes_of(matte.width, matte.height, n) <= MOST_BYTES), 1)
