"""Programs and capture archives for tests."""

import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from workflows.images.integer_formats import encode_png
from workflows.programs.parts import Bernoulli, Constant, Monitor
from workflows.programs.program import Program


def nested_program(
    monitor: tuple[int, int] = (1280, 960),
    *,
    bands: Sequence[tuple[int, int, int]],
    levels: int = 8,
    seed: int = 7,
) -> Program:
    """A program of constant levels and random grids without offsets.

    Parameters
    ----------
    monitor : (int, int)
        Width and height in pixels.
    bands : sequence of (columns, rows, count)
        From coarse to fine, each grid a whole multiple of the one before.
    levels : int
        Constant levels from 0 to 1, at least 2.
    seed : int
        Of the first band; each further band adds 1.
    """
    grids = [
        Bernoulli(kind="bernoulli", columns=columns, rows=rows, count=count, seed=seed + i)
        for i, (columns, rows, count) in enumerate(bands)
    ]
    constant = Constant(kind="constant", levels=tuple(np.linspace(0, 1, levels).round(6).tolist()))
    return Program(monitor=Monitor(width=monitor[0], height=monitor[1]), parts=(constant, *grids))


def captured(program: Program, see: Callable[[int, NDArray[np.uint8]], NDArray[np.floating]]) -> bytes:
    """The archive of a capture in linear light, 16 bits deep.

    Parameters
    ----------
    see : callable
        Returns what the camera makes of a pattern, (height, width, channels), 1 being full scale, by its number and its
        picture. It is called for one after another.
    """
    pictures = enumerate(program.pictures(0, program.count))
    seen = (np.clip(see(n, picture), 0, 1) for n, picture in pictures)
    return stills_archive(program, (np.rint(65535 * light).astype(np.uint16) for light in seen))


def stills_archive(
    program: Program, stills: Iterable[NDArray[np.unsignedinteger]], mask: NDArray[np.bool_] | None = None
) -> bytes:
    """The archive of a capture in linear light: one still of each pattern, and the pixels to be recovered."""
    files = {f"{n}.png": encode_png(still) for n, still in enumerate(stills)}
    manifest = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json"),
        "frames": [{"file": name, "pattern": n} for n, name in enumerate(files)],
        "response": "linear",
    }
    if mask is not None:
        manifest["mask"] = "mask.png"
        files["mask.png"] = encode_png(mask[..., np.newaxis].astype(np.uint8) * 255)
    return zip_bytes({"capture.json": json.dumps(manifest).encode()} | files)


def zip_bytes(files: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A ZIP of files with a fixed date: the same files give the same bytes."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return target.getvalue()
