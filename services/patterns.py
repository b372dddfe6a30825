"""`envmatte patterns`: a program as files, for whatever shows pictures on a monitor."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.errors import OptionError
from workflows.images import to_integers
from workflows.program import Program


def write(program: Program, folder: Path, progress: Callable[[int], None]) -> None:
    """Write `program.json`, the capture format's `program`, and a numbered PNG of each pattern.

    Parameters
    ----------
    program : Program
        Without images; what it shows is rounded to 8 bits.
    folder : Path
        Made whole or not at all; may be there if it is empty.
    progress : callable
        Called with the number of patterns written.

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
        record = program.model_dump(mode="json", exclude_defaults=True)
        (made / "program.json").write_text(json.dumps(record, indent=1) + "\n")
        for n, picture in enumerate(program.pictures(0, program.count)):
            _image(picture).save(made / f"{n:05d}.png")
            progress(n + 1)
        os.replace(made, folder)


def _image(picture: NDArray[np.float32]) -> Image.Image:
    """A picture in the fewest bits that hold it: black and white, grey, or RGB."""
    codes = to_integers(picture, np.dtype(np.uint8))
    if np.any(codes != codes[:, :, :1]):
        return Image.fromarray(codes)
    grey = codes[:, :, 0]
    return Image.fromarray(grey > 0 if np.isin(grey, (0, 255)).all() else grey)
