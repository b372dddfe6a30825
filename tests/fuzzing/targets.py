"""Every parser of untrusted input as a target: what makes its input, and what reads it."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from services.runtime.problems import problem_of
from storage.errors import InvalidInput
from tests.fuzzing import archives, changes, films, headers, images, requests, seeds
from tests.fuzzing.campaign import GUARDED, MEMORY, Refused, Target
from tests.fuzzing.seeds import Files

ATTRIBUTES = rb"chlist\0|box2i\0|tiledesc\0|compression\0|string\0|lineOrder\0"
"""Attributes of an EXR, before their values."""


def refusing(read: Callable[[bytes, Path], object], data: bytes, folder: Path) -> None:
    """Run a parser; an error that the API can report as a problem counts as a refusal."""
    try:
        read(data, folder)
    except InvalidInput as error:
        json.dumps(problem_of(error), ensure_ascii=False, allow_nan=False).encode()
        raise Refused from error


def of_files(
    marks: bytes | None = None, *others: Callable[[Random, bytes], bytes]
) -> Callable[[Random, Files], bytes]:
    """Makes damaged files out of valid ones, half of the time by one of `others` if given."""
    return partial(_of_files, marks, others)


def _of_files(
    marks: bytes | None,
    others: Sequence[Callable[[Random, bytes], bytes]],
    random: Random,
    valid: Files,
) -> bytes:
    one = random.choice(valid)
    if others and random.random() < 0.5:
        return random.choice(others)(random, one)
    return changes.damaged(random, one, marks, random.choice(valid))


def target(
    name: str,
    make: Callable[[Random, Any], bytes],
    read: Callable[[bytes, Path], object],
    valid: Callable[[], Any] = tuple,
    quick: int = 100,
    memory: int = MEMORY,
) -> Target:
    return Target(name, make, partial(refusing, read), valid, quick, memory)


ALL = (
    target("zip", archives.make_zip, archives.read_zip),
    target("capture-archive", archives.make_capture_archive, archives.read_capture_archive),
    target("program", archives.make_program, archives.read_program),
    target("options", headers.make_options, headers.read_options),
    target("headers", headers.make_headers, headers.read_headers, quick=1000),
    target("url", headers.make_url, headers.read_url, quick=1000),
    target("requests", requests.make, requests.read, requests.compile_kernels, quick=60),
    target("png", of_files(rb"IHDR|PLTE|IDAT|tRNS|iCCP", changes.damaged_png), images.read_image, seeds.pngs),
    target("jpeg", of_files(rb"\xff[\xc0-\xff]"), images.read_image, seeds.jpegs),
    target("tiff", of_files(None, changes.damaged_tiff), images.read_image, seeds.tiffs),
    target("heic", of_files(images.BOXES), images.read_image, seeds.heics),
    target(
        "web-picture",
        of_files(rb"VP8[ LX]|ANIM|ANMF|ALPH|ipco|ispe|av1C|iloc|GIF89a|\x2c"),
        images.read_any_backdrop,
        seeds.webs,
    ),
    target(
        "backdrop",
        of_files(rb"IHDR|iCCP|ICC_PROFILE|colr", images.profiled),
        images.read_any_backdrop,
        seeds.backdrops,
    ),
    target("float-tiff", of_files(None, changes.damaged_tiff), images.read_floats, seeds.float_tiffs),
    target("exr", of_files(ATTRIBUTES), images.read_floats, seeds.exrs),
    target("raw", images.make_raw, images.read_raw, seeds.raws),
    target(
        "video",
        of_files(films.MARKS, films.damaged_film),
        films.read_clip,
        seeds.clips,
        quick=60,
        memory=GUARDED,
    ),
    target(
        "clip",
        of_files(films.MARKS, films.damaged_film),
        films.read_backdrop_clip,
        seeds.clips,
        quick=20,
        memory=GUARDED,
    ),
    target(
        "matte-archive",
        archives.make_matte_archive,
        archives.read_matte_archive,
        archives.matte_archive_files,
        quick=15,
    ),
    target("capture", films.make_capture, films.read_capture, films.capture_files, quick=20, memory=GUARDED),
)
