"""A program as files: its record, a PNG of each pattern, and all of them in a folder or a ZIP."""

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import ValidationError

from storage.errors import OptionError
from workflows.images.integer_formats import to_integers
from workflows.programs.border import Border
from workflows.programs.presets import PRESETS, preset
from workflows.programs.program import Images, Program

Size = tuple[int, int]
USUAL = 1280, 960
"""The screen that a preset is made for, if none is named."""
PROGRAM_BYTES = 8 << 20


def given(name: str) -> str | Program:
    """A preset's name, or the program in a JSON file: all there is in it, or the `program` of a `capture.json`.

    Raises
    ------
    OptionError
        If it is neither.
    pydantic.ValidationError
        If it is no program.
    """
    if name in PRESETS:
        return name
    file = Path(name)
    if not file.is_file():
        raise OptionError(
            f"{name!r} is not one of {', '.join(map(repr, PRESETS))}, and no file", field="program"
        )
    if file.stat().st_size > PROGRAM_BYTES:
        raise OptionError(f"{name} has more than {PROGRAM_BYTES} bytes: that is no program", field="program")
    try:
        found = json.loads(file.read_bytes())
    except ValueError as error:
        raise OptionError(f"{name} is no JSON: {error}", field="program") from error
    return Program.model_validate(found.get("program", found) if isinstance(found, dict) else found)


def fitted(given: str | Program, screen: Size | None, *, bordered: bool) -> Program:
    """A program for a screen.

    Parameters
    ----------
    given : str or Program
        The name of a preset, or a program.
    screen : (width, height), optional
        In pixels; left out, 1280 x 960 for a preset, and the program's own monitor.
    bordered : bool
        Whether the patterns are to be shown inside of a border (`workflows.programs.border`) on the screen.

    Returns
    -------
    Program
        Its monitor is what the patterns cover of the screen.

    Raises
    ------
    OptionError
        If there is no such preset, it has no room on the screen, its grids do not nest, or it shows images, which are
        files already.
    """
    if isinstance(given, Program) and screen is None:
        program = given
    else:
        size = screen or USUAL
        if bordered:
            size = Border.on(*size).inner[2:]
        program = preset(given, *size) if isinstance(given, str) else _on(given, *size)
    if any(isinstance(part, Images) for part in program.parts):
        raise OptionError(
            "this program has a part of images, which are pictures already: leave it out", field="program"
        )
    program.bands()  # a capture of grids that do not nest would be refused
    return program


def _on(program: Program, width: int, height: int) -> Program:
    """A program on a monitor of another size."""
    monitor = program.monitor.model_dump() | {"width": width, "height": height}
    try:
        return Program.model_validate(program.model_dump() | {"monitor": monitor})
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise OptionError(f"on a monitor of {width} x {height} pixels: {why}", field="monitor") from error


def record(program: Program) -> dict[str, Any]:
    """A program as the capture format writes it."""
    return program.model_dump(mode="json", exclude_defaults=True)


def pictures(program: Program, first: int = 0, last: int | None = None) -> Iterator[NDArray[np.uint8]]:
    """The pictures of the patterns from ``first`` up to ``last``, (height, width, 1 or 3) uint8, one after another."""
    return program.mapped(_codes, first, program.count if last is None else last)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture as PNG in the fewest bits that hold it: black and white, grey, or RGB."""
    if np.any(picture != picture[:, :, :1]):
        image = Image.fromarray(picture)
    else:
        grey = picture[:, :, 0]
        image = Image.fromarray(grey > 0 if np.isin(grey, (0, 255)).all() else grey)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def archive(program: Program) -> Iterator[bytes]:
    """A ZIP of `program.json` and the numbered PNGs, part by part: no more than one picture is held."""
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_STORED) as target:
        for name, data in _files(program):
            target.writestr(zipfile.ZipInfo(name), data)  # of a fixed date: the same bytes at any time
            yield pipe.taken()
    yield pipe.taken()


def write(program: Program, folder: Path, progress: Callable[[int, int], None]) -> None:
    """Write `program.json`, the capture format's `program`, and a numbered PNG of each pattern.

    Parameters
    ----------
    program : Program
        Without images; what it shows is rounded to 8 bits.
    folder : Path
        Made whole or not at all; may be there if it is empty.
    progress : callable
        Called with the number of patterns written, and of all.

    Raises
    ------
    OptionError
        If the folder is not empty.
    """
    folder = folder.resolve()
    if folder.exists() and any(folder.iterdir()):
        raise OptionError(f"{folder} is not empty: name another folder, or empty it first", field="folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as beside:
        made = Path(beside, "patterns")
        made.mkdir()
        for n, (name, data) in enumerate(_files(program)):
            (made / name).write_bytes(data)
            if n:
                progress(n, program.count)
        os.replace(made, folder)


def _files(program: Program) -> Iterator[tuple[str, bytes]]:
    """The files of a program: its record, and then its patterns."""
    yield "program.json", (json.dumps(record(program), indent=1) + "\n").encode()
    for n, picture in enumerate(pictures(program)):
        yield f"{n:05d}.png", png(picture)


def _codes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return to_integers(values, np.dtype(np.uint8)).astype(np.uint8, copy=False)


class _Pipe(io.RawIOBase):
    """A file that zipfile writes to, and that gives away what was written."""

    def __init__(self) -> None:
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:  # type: ignore[override]
        self._held += data
        return len(data)

    def taken(self) -> bytes:
        """What was written since the last call."""
        data, self._held = bytes(self._held), bytearray()
        return data
