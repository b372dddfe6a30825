"""The script that makes a matte's nodes in Blender: `files/blender.py`, with the figures of the matte in it."""

from pathlib import Path
from pprint import pformat
from typing import IO

from storage.layout.mattes import Matte
from workflows.composite.backdrops.around import Plate
from workflows.recovery.pyramid import Pyramid

NAME = "envmatte glass"
"""Of the group of nodes."""
_SCRIPT = Path(__file__).with_name("files") / "blender.py"
_PLACE = "MATTE: dict[str, Any] = {}\n"


def write_blender(matte: Matte, file: IO[bytes], lookups: int, plate: Plate | None = None) -> None:
    """Write the script; parameters are those of `write_nuke`."""
    figures = {
        "name": NAME,
        "size": (matte.width, matte.height),
        "levels": Pyramid.over(matte.columns, matte.rows).grids,
        "lookups": lookups,
        "crosstalk": matte.attributes["crosstalk"],
        "plate": plate and {name: value.tolist() for name, value in plate._asdict().items()},
    }
    before, _, after = _SCRIPT.read_text().partition(_PLACE)
    file.write(f"{before}MATTE: dict[str, Any] = {pformat(figures, width=100)}\n{after}".encode())
