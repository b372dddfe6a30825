"""A program as files: a JSON file, and a PNG of each pattern, in a folder or a ZIP."""

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
from workflows.programs.parts import Images
from workflows.programs.preset_names import PRESETS
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.untrusted.validation import field_and_reason, reason

Size = tuple[int, int]
DEFAULT_SCREEN = 1280, 960
"""The screen that a preset is made for if none is given, in pixels."""
PROGRAM_BYTES = 8 << 20
"""The largest program file."""


def load_program(name: str) -> str | Program:
    """The name of a preset as it is, or the program in a JSON file: a program, or a capture.json.

    Raises
    ------
    OptionError
        If ``name`` is neither a preset nor a JSON file with a program.
    """
    if name in PRESETS:
        return name
    file = Path(name)
    if not file.is_file():
        raise OptionError(
            f"{name!r} is not one of {', '.join(map(repr, PRESETS))}, nor a file", field="program"
        )
    if file.stat().st_size > PROGRAM_BYTES:
        raise OptionError(f"{name} has more than {PROGRAM_BYTES} bytes: it is not a program", field="program")
    try:
        found = json.loads(file.read_bytes())
    except ValueError as error:
        raise OptionError(f"{name} is not JSON: {error}", field="program") from error
    try:
        return Program.model_validate(found.get("program", found) if isinstance(found, dict) else found)
    except ValidationError as error:
        why = " ".join(field_and_reason(error.errors())).strip()
        raise OptionError(f"{name} has no program: {why}", field="program") from error


def fit_to_screen(
    program: str | Program, screen: Size | None, *, bordered: bool, grey: bool = False
) -> Program:
    """Make a preset or a program for a screen.

    Parameters
    ----------
    program : str or Program
        The name of a preset, or a program.
    screen : (width, height), optional
        In pixels; by default 1280 x 960 for a preset, and a program's own monitor.
    bordered : bool
        Whether the patterns are shown inside a border (`workflows.programs.border`) on the screen, to be filmed.
    grey : bool
        Whether a preset must be in black and white, as bordered ones are.

    Returns
    -------
    Program
        Its monitor is the part of the screen that the patterns cover.

    Raises
    ------
    OptionError
        If there is no such preset, it does not fit on the screen, its grids do not nest, or it shows images, which are
        files already.
    """
    if not isinstance(program, Program) or screen is not None:
        size = screen or DEFAULT_SCREEN
        if bordered:
            size = Border.on(*size).inner[2:]
        program = (
            preset(program, *size, grey=grey or bordered)
            if isinstance(program, str)
            else _resize(program, *size)
        )
    if any(isinstance(part, Images) for part in program.parts):
        raise OptionError(
            "this program has a part of images, which are files already: leave it out", field="program"
        )
    program.bands()  # a capture of grids that do not nest would be refused
    return program


def _resize(program: Program, width: int, height: int) -> Program:
    """The same program for a monitor of another size."""
    monitor = program.monitor.model_dump() | {"width": width, "height": height}
    try:
        return Program.model_validate(program.model_dump() | {"monitor": monitor})
    except ValidationError as error:
        why = reason(error.errors()[0])
        raise OptionError(f"on a monitor of {width} x {height} pixels: {why}", field="monitor") from error


def program_json(program: Program) -> dict[str, Any]:
    """A program as capture.json writes it."""
    return program.model_dump(mode="json", exclude_defaults=True)


def pictures(program: Program, first: int = 0, last: int | None = None) -> Iterator[NDArray[np.uint8]]:
    """Pictures of the patterns from ``first`` up to ``last``, (height, width, 1 or 3) uint8 each."""
    return program.mapped(_codes, first, program.count if last is None else last)


def png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture as PNG in the fewest bits that hold it: black and white, grey, or RGB."""
    if np.any(picture != picture[:, :, :1]):
        image = Image.fromarray(picture)
    else:
        grey = picture[:, :, 0]
        image = Image.fromarray(grey > 0 if np.isin(grey, (0, 255)).all() else grey)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def zip_program(program: Program) -> Iterator[bytes]:
    """A ZIP of `program.json` and the numbered PNGs, in parts: no more than one picture is held in memory."""
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_STORED) as target:
        for name, data in _files(program):
            target.writestr(zipfile.ZipInfo(name), data)  # its date is fixed
            yield pipe.take()
    yield pipe.take()


def write_folder(program: Program, folder: Path, progress: Callable[[int, int], None]) -> None:
    """Write `program.json`, the ``program`` of a capture.json, and a numbered PNG of each pattern.

    Parameters
    ----------
    program : Program
        Without images. Patterns are rounded to 8 bits.
    folder : Path
        Created completely or not at all; it may exist if it is empty.
    progress : callable
        Called with the number of patterns written, and of all patterns.

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
    """Names and contents of a program's files: the JSON first, then the patterns."""
    yield "program.json", (json.dumps(program_json(program), indent=1) + "\n").encode()
    for n, picture in enumerate(pictures(program)):
        yield f"{n:05d}.png", png(picture)


def _codes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return to_integers(values, np.dtype(np.uint8)).astype(np.uint8, copy=False)


class _Pipe(io.RawIOBase):
    """A file for zipfile to write to, from which the bytes are taken as they come."""

    def __init__(self) -> None:
        self._written = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:  # type: ignore[override]
        self._written += data
        return len(data)

    def take(self) -> bytes:
        """The bytes written since the last call."""
        data, self._written = bytes(self._written), bytearray()
        return data
