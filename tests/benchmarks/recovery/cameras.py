"""Tells of the files of real cameras whether they are read as a frame, a film or a backdrop, or why they are refused.

    python -m tests.benchmarks.recovery.cameras FOLDER

FOLDER holds files as cameras write them. Each is read as ingest reads a frame and a film, and as the service reads a
backdrop, in a decoder. Prints what comes out of it, or what it is refused with.
"""

import argparse
import io
import json
import zipfile
from pathlib import Path

import numpy as np

from services.decoding.pool import Decoders
from storage.errors import InvalidInput
from workflows.ingest import films, stills
from workflows.ingest.archive import CaptureArchive
from workflows.untrusted.decoder import Decoder
from workflows.untrusted.limits import Limits

LIMITS = Limits(unpacked=1 << 32, memory=1 << 30)
FRAMES = 1_000_000


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    for file in sorted(path for path in parser.parse_args().folder.iterdir() if path.is_file()):
        print(f"{file.name}: {'; '.join(read(file))}", flush=True)


def read(file: Path) -> list[str]:
    """What a file is read as, and why a picture is no frame or backdrop, or a file nothing at all."""
    data = file.read_bytes()
    taken: dict[str, str] = {}
    refused: dict[str, str] = {}
    for kind, how in (("frame", frame), ("backdrop", backdrop), ("film", film)):
        try:
            taken[kind] = f"{kind} of {how(file.name, data)}"
        except InvalidInput as error:
            refused[kind] = f"no {kind}: {error.detail}"
        except Exception as error:  # neither read nor refused
            refused[kind] = f"no {kind}, by accident: {error!r}"
    if "film" in taken:
        refused.clear()
    elif taken:
        del refused["film"]
    return [*taken.values(), *refused.values()]


def frame(name: str, data: bytes) -> str:
    with Decoder(LIMITS.image_bytes) as decoder:
        return _shape(stills.read(decoder, _archive(name, data), name))


def film(name: str, data: bytes) -> str:
    with Decoder(LIMITS.image_bytes) as decoder:
        found, ticks, _ = films.times(decoder, io.BytesIO(data), name, FRAMES)
    gaps = np.diff(ticks) * float(found.time_base)
    rate = "" if not gaps.size else f", {1 / gaps.max():.1f} to {1 / gaps.min():.1f} a second"
    lost = ", some lost" if found.lost else ""
    return (
        f"{found.width} x {found.height}, {len(ticks)} frames{rate}{', interlaced' * found.interlaced}{lost}"
    )


def backdrop(name: str, data: bytes) -> str:
    decoders = Decoders(LIMITS.image_bytes)
    try:
        return _shape(decoders.decode(data, "srgb"))
    finally:
        decoders.close()


def _shape(pixels: np.ndarray) -> str:
    height, width, channels = pixels.shape
    return f"{width} x {height}, {channels} channels of {pixels.dtype}"


def _archive(name: str, data: bytes) -> CaptureArchive:
    """A capture archive that has the file as each of its frames."""
    parts = [
        {"kind": "constant", "levels": [0, 1]},
        {"kind": "stripes", "axis": "x", "count": 1},
    ]
    manifest = {
        "format": "envmatte-capture/1",
        "program": {"monitor": {"width": 4, "height": 4}, "parts": parts},
        "frames": [{"file": name, "pattern": n} for n in range(3)],
    }
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as out:
        out.writestr(name, data)
        out.writestr("capture.json", json.dumps(manifest))
    return CaptureArchive(target, LIMITS)


if __name__ == "__main__":
    main()
