"""How much of a matte is there: all of it, or a preview and the blocks that are recovered."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TypeVar

from services.api.context import Context
from storage.database.engine import reading
from storage.errors import Conflict, Corrupt
from storage.layout.mattes import Matte, preview_of
from storage.records import mattes
from storage.records import tiles as tile_records
from workflows.mattes.options import parse_options
from workflows.mattes.tiles import cut

R = TypeVar("R")
HEADER = "Envmatte-Recovered"
"""The share of a matte's blocks that are recovered, from 0 to 1."""


@dataclass(frozen=True)
class Progress:
    """How much of a matte is there.

    Attributes
    ----------
    id : str
    blocks : set of (int, int), optional
        Rows and columns of the recovered blocks; None if all are.
    share : float
        Of all blocks, from 0 to 1.
    preview : int, optional
        Of how many rows and columns a preview has one; None if all is recovered, and if there is no preview.
    """

    id: str
    blocks: frozenset[tuple[int, int]] | None = None
    share: float = 1.0
    preview: int | None = None

    @property
    def whole_frame(self) -> str:
        """Name in the store of what shows the whole frame: the matte, or its preview.

        Raises
        ------
        Conflict
            If there is neither.
        """
        if self.blocks is None:
            return self.id
        if self.preview is None:
            raise Conflict(f"matte {self.id} is still being recovered, and has no preview")
        return preview_of(self.id)

    @property
    def headers(self) -> dict[str, str]:
        """What an answer says of it."""
        return {HEADER: f"{self.share:.4f}"}


def progress_of(context: Context, id: str) -> Progress:
    """How much of a matte is there.

    Raises
    ------
    NotFound
        If there is no such matte.
    Conflict
        If nothing of it is there.
    """
    with context.stored(mattes.get, id) as row:
        if row.state == "ready":
            return Progress(id)
        done, preview = [], None
        if row.state == "recovering":
            with reading(context.engine) as c:
                done = tile_records.done(c, row.job)
            preview = (row.figures or {}).get("preview")
        if not done and preview is None:
            raise Conflict(f"matte {id} is {row.state}, and nothing of it is there yet; see job {row.job}")
        matte = context.cache.matte(id)
        tiles = cut(matte, parse_options(row.options).tile or matte.block)
        blocks = frozenset(block for tile in done for block in product(*tiles[tile]))
        if len(blocks) == matte.block_rows * matte.block_columns:
            return Progress(id)  # it is complete, and its preview may be gone, just before it is ready
        return Progress(id, blocks, len(blocks) / (matte.block_rows * matte.block_columns), preview)


def while_there(context: Context, progress: Progress, work: Callable[[Progress], R]) -> R:
    """Do some work with a matte; again if meanwhile it was completed, which removes its preview.

    Raises
    ------
    NotFound
        If the matte was deleted meanwhile.
    """
    try:
        return work(progress)
    except (Corrupt, FileNotFoundError):
        now = progress_of(context, progress.id)
        if progress.preview is None or now.preview is not None:
            raise
    return work(now)


def open_whole_frame(context: Context, id: str) -> tuple[Progress, Matte]:
    """Open what shows the whole frame of a matte: the matte, or its preview."""

    def opened(progress: Progress) -> tuple[Progress, Matte]:
        return progress, context.cache.matte(progress.whole_frame)

    return while_there(context, progress_of(context, id), opened)
