"""A bundle: the ZIP of a capture and its capture.json, format envmatte-capture/1, checked as hostile."""

import struct
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Annotated, BinaryIO, Literal, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError

from storage.errors import CaptureError
from workflows.images.tone_curves import Response
from workflows.programs.border import Border
from workflows.programs.program import Images, Program
from workflows.untrusted import zip_files
from workflows.untrusted.limits import Limits

MANIFEST = "capture.json"
MANIFEST_BYTES = 4 << 20
"""Of capture.json: 200 for each of the most frames."""
MANIFEST_NODES = 150_000
"""Objects and lists in it: an empty one takes two bytes, and 300 while it is read."""
ENTRIES = 20_000
NAME_LENGTH = 26
"""Where an entry's header has the lengths of its name and of the field after it (APPNOTE, sect. 4.3.7)."""
PIECE = 1 << 20
"""Bytes that are unpacked at once."""
TAGS = {"constant", "bernoulli", "images", "Gamma"}
"""What pydantic adds to the way to a field: which member of a union it took."""


class Frame(BaseModel):
    """One frame: its image file in the bundle, the pattern it saw, and for how long, in seconds or any other unit."""

    model_config = ConfigDict(frozen=True)
    file: str
    pattern: int = Field(ge=0)
    exposure: Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)] = 1.0


class Video(BaseModel):
    """A recording of the program from before its start until after its end, in place of frames."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    file: str
    patterns_per_second: float = Field(ge=0.01, le=120)
    border: Border | None = None


class Manifest(BaseModel):
    """capture.json."""

    model_config = ConfigDict(frozen=True)
    format: Literal["envmatte-capture/1"]
    name: str = Field(default="", max_length=200)
    program: Program
    response: Response = "unknown"
    # One fault is told: a list of all there are takes a kilobyte for each.
    frames: Annotated[tuple[Frame, ...], FailFast()] = ()
    video: Video | None = None
    mask: str | None = None


class Bundle:
    """An opened bundle.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    limits : Limits

    Raises
    ------
    CaptureError
        Naming the entry, and the field of capture.json, that is wrong and why.
    """

    def __init__(self, file: BinaryIO, limits: Limits) -> None:
        self._limits = limits
        self._file = file
        self._archive = zip_files.opened(file, CaptureError)
        self._entries = zip_files.entries(self._archive, ENTRIES, limits.unpacked, CaptureError)
        self.manifest = self._read_manifest()
        self._check_manifest()

    def read(self, entry: str) -> bytes:
        """The bytes of an entry.

        Raises
        ------
        CaptureError
            If it is not there, too large, or damaged.
        """
        info = self._entries.get(entry)
        if info is None:
            raise CaptureError(f"{entry} is not in the archive", entry=entry)
        return zip_files.read(self._archive, info, self._limits.image, CaptureError)

    @contextmanager
    def open(self, entry: str) -> Iterator[BinaryIO]:
        """An entry as a seekable file, for what is too large to be read at once.

        A stored entry is read where it lies; one that is packed is unpacked into a temporary file.

        Raises
        ------
        CaptureError
            If it is damaged.
        """
        info = self._entries[entry]
        with ExitStack() as held:
            try:
                with self._archive.open(info) as packed:
                    if info.compress_type == zipfile.ZIP_STORED:
                        # What zipfile gives, sent back, reads all that lies before once more.
                        self._file.seek(info.header_offset + NAME_LENGTH)
                        name, extra = struct.unpack("<HH", self._file.read(4))
                        start = info.header_offset + NAME_LENGTH + 4 + name + extra
                        file = cast(BinaryIO, _Window(self._file, start, info.file_size))
                    else:
                        file = cast(BinaryIO, held.enter_context(tempfile.TemporaryFile()))
                        for done in range(0, info.file_size, PIECE):
                            file.write(packed.read(min(PIECE, info.file_size - done)))
                        file.seek(0)
            except zip_files.UNREADABLE as error:
                raise CaptureError(f"{entry} is damaged in the archive: {error}", entry=entry) from error
            yield file

    def _read_manifest(self) -> Manifest:
        info = self._entries.get(MANIFEST)
        if info is None:
            raise CaptureError(f"there is no {MANIFEST} at the root of the archive", entry=MANIFEST)
        if info.file_size > MANIFEST_BYTES:
            raise CaptureError(
                f"{MANIFEST} is larger than {MANIFEST_BYTES} bytes", entry=MANIFEST, limit=MANIFEST_BYTES
            )
        text = self.read(MANIFEST)
        if text.count(b"{") + text.count(b"[") > MANIFEST_NODES:
            raise CaptureError(
                f"{MANIFEST} has more than {MANIFEST_NODES} objects and lists",
                entry=MANIFEST,
                limit=MANIFEST_NODES,
            )
        try:
            return Manifest.model_validate_json(text)
        except ValidationError as error:
            # Of the errors of a union's members, the one that got furthest into one says most.
            first = max(error.errors(include_url=False, include_context=False), key=lambda e: len(e["loc"]))
            names = [str(part) for part in first["loc"] if part not in TAGS]
            field = ".".join(name for name in names if "[" not in name)
            what = first["msg"].removeprefix("Value error, ")
            raise CaptureError(
                f"{MANIFEST}: {field + ': ' if field else ''}{what}", entry=MANIFEST, field=field
            ) from error

    def _check_manifest(self) -> None:
        manifest = self.manifest
        if manifest.video is not None and manifest.frames:
            raise CaptureError(
                f"{MANIFEST} names both frames and a video: give one of them", entry=MANIFEST, field="video"
            )
        if manifest.video is None and not manifest.frames:
            raise CaptureError(f"{MANIFEST} names no frames", entry=MANIFEST, field="frames")
        count = manifest.program.count
        frames = len(manifest.frames) or count
        self._limits.see_that_frames_may(frames, entry=MANIFEST, field="frames")
        files = [(f"frames.{n}.file", frame.file) for n, frame in enumerate(manifest.frames)]
        if manifest.video is not None:
            files.append(("video.file", manifest.video.file))
        if manifest.mask is not None:
            files.append(("mask", manifest.mask))
        for at, part in enumerate(manifest.program.parts):
            if isinstance(part, Images):
                files += [(f"program.parts.{at}.files.{n}", name) for n, name in enumerate(part.files)]
        for field, name in files:
            if name not in self._entries or self._entries[name].is_dir():
                raise CaptureError(
                    f"{MANIFEST} names {name!r}, which is not in the archive", entry=name, field=field
                )
        for n, frame in enumerate(manifest.frames):
            if frame.pattern >= count:
                raise CaptureError(
                    f"{frame.file} saw pattern {frame.pattern}, but the program's patterns are 0 to {count - 1}",
                    entry=frame.file,
                    field=f"frames.{n}.pattern",
                )
        if manifest.video is not None:
            return
        seen = np.zeros(count, bool)
        seen[[frame.pattern for frame in manifest.frames]] = True
        if not seen.all():
            missing = np.flatnonzero(~seen)
            raise CaptureError(
                f"{len(missing)} of {count} patterns have no frame, the first of them pattern {missing[0]}",
                entry=MANIFEST,
                field="frames",
            )


class _Window:
    """A part of a file as a file of its own, to read."""

    def __init__(self, file: BinaryIO, start: int, size: int) -> None:
        self._file, self._start, self._size, self._at = file, start, size, 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = max(offset + (0, self._at, self._size)[whence], 0)
        return self._at

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self._at, 0)
        self._file.seek(self._start + self._at)
        data = self._file.read(left if size < 0 else min(size, left))
        self._at += len(data)
        return data
