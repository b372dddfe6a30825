"""ZIPs, archives of captures and mattes, and programs: how damaged ones are made, and what must hold for the result."""

import io
import json
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from random import Random

import numpy as np

from storage.errors import ArchiveError, CaptureError
from storage.layout.matte_archive import Archive
from storage.objects.checksums import seal
from storage.objects.store import Objects
from tests.fuzzing import changes, seeds
from tests.fuzzing.campaign import LIMITS, Refused
from tests.fuzzing.seeds import Files
from tests.parts.captures import zip_bytes
from tests.workflows.mattes.imports.conftest import make_matte, pack_chunk, signed, unpack_chunk, unpacked
from workflows.composite import composite
from workflows.ingest.archive import CaptureArchive
from workflows.mattes.imports.importing import take_in
from workflows.programs.program import Program
from workflows.untrusted import zip_files


def make_zip(random: Random, valid: Files) -> bytes:
    return changes.damaged_zip(random, seeds.capture_files(), lambda r, name, data: changes.damaged(r, data))


def read_zip(data: bytes, folder: Path) -> None:
    archive = zip_files.open_archive(io.BytesIO(data), CaptureError)
    for info in zip_files.entries(archive, 100, LIMITS.unpacked, CaptureError).values():
        assert len(zip_files.read(archive, info, 1 << 16, CaptureError)) <= info.file_size


def make_capture_archive(random: Random, valid: Files) -> bytes:
    manifest = random.choice((seeds.MANIFEST, seeds.FILMED))
    files = seeds.capture_files(manifest)
    if random.random() < 0.3:
        return changes.damaged_zip(random, files, lambda r, name, data: changes.damaged(r, data))
    return zip_bytes(files | {"capture.json": changes.other_json(random, manifest)}, zipfile.ZIP_DEFLATED)


def read_capture_archive(data: bytes, folder: Path) -> None:
    archive = CaptureArchive(io.BytesIO(data), LIMITS)
    manifest = archive.manifest
    for name in {frame.file for frame in manifest.frames}:
        archive.read(name)
    if manifest.video is not None:
        with archive.open(manifest.video.file) as file:
            file.read()
    use_program(manifest.program)
    json.dumps(manifest.program.model_dump(mode="json"), allow_nan=False).encode()


def use_program(program: Program) -> None:
    """What the API does with an archive before a job reads it."""
    assert program.count > len(program.constants[0]) > 1
    program.bands()
    assert Program.model_validate(program.model_dump(mode="json")) == program


def make_program(random: Random, valid: Files) -> bytes:
    return changes.other_json(random, seeds.MANIFEST["program"])


def read_program(data: bytes, folder: Path) -> None:
    try:
        program = Program.model_validate_json(data)
    except ValueError as error:
        raise Refused from error
    use_program(program)
    pixels = program.monitor.width * program.monitor.height
    if pixels <= 1 << 20 and not any(part.kind == "images" for part in program.parts):
        for picture in islice(program.pictures(0, program.count), 3):
            assert picture.shape[:2] == (program.monitor.height, program.monitor.width)


@cache
def matte_archive_files() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        objects = Objects(Path(folder).as_uri())
        make_matte(objects)
        return unpacked(b"".join(Archive(objects, "m")))


def make_matte_archive(random: Random, valid: dict[str, bytes]) -> bytes:
    files = dict(valid)
    kind = random.randrange(4)
    if kind == 0:
        return changes.damaged_zip(random, files, lambda r, name, data: changes.damaged(r, data))
    name = random.choice([*files])
    if name.endswith(".json"):
        files[name] = changes.other_json(random, json.loads(files[name]))
        if random.random() < 0.8:  # with a correct checksum, if it still has one
            with suppress(ValueError, TypeError, AttributeError, RecursionError):
                files[name] = seal(files[name])
    elif kind == 1:
        files[name] = changes.damaged(random, files[name])
    else:
        change = random.choice((changes.damaged, changes.other_float))
        files[name] = pack_chunk(change(random, unpack_chunk(files[name])))
    if random.random() < 0.1:
        del files[random.choice([*files])]
    try:
        return signed(files)
    except (ValueError, TypeError, KeyError, RecursionError):  # the manifest itself is changed
        return zip_bytes(files)


def read_matte_archive(data: bytes, folder: Path) -> None:
    objects = Objects((folder / "store").as_uri())
    try:
        matte = take_in(io.BytesIO(data), objects, "n", replace(LIMITS, memory=1 << 20))
    except ArchiveError:
        assert objects.paths_below("mattes/n") == set()
        raise
    assert matte.width * matte.height < 1 << 20
    light = np.linspace(0, 1, 5 * 40 * 3, dtype=np.float32).reshape(5, 40, 3)
    assert np.isfinite(composite(matte, light, threads=1)).all()
    again = b"".join(Archive(objects, "n"))
    take_in(io.BytesIO(again), objects, "o", LIMITS)
