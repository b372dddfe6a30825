"""A capture archive: the uploaded ZIP with capture.json and the files it names. Nothing in it is trusted."""

import struct
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import BinaryIO, cast

import numpy as np

from storage.errors import CaptureError
from workflows.ingest.manifest import MANIFEST, MANIFEST_BYTES, Manifest, parse_manifest
from workflows.programs.parts import Images
from workflows.untrusted import zip_files
from workflows.untrusted.limits import MAX_FRAMES, Limits

MAX_ENTRIES = 2 * MAX_FRAMES + 2
"""A picture of each pattern besides, the mask, and capture.json."""
NAME_LENGTH_AT = 26
"""Where a local file header has the lengths of the name and of the extra field (APPNOTE, sect. 4.3.7)."""
MATTE = "zarr.json"
"""An entry of the archives of mattes."""
PIECE = 1 << 20
"""Bytes unpacked at a time."""


class CaptureArchive:
    """An open capture archive whose manifest has been checked.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    limits : Limits

    Attributes
    ----------
    manifest : Manifest

    Raises
    ------
    CaptureError
        Naming the entry, and the field of capture.json, that is wrong, and why.
    OverLimit
        If the capture has more frames than allowed.
    """

    def __init__(self, file: BinaryIO, limits: Limits) -> None:
        self._limits = limits
        self._file = file
        self._archive = zip_files.open_archive(file, CaptureError)
        self._entries = zip_files.entries(self._archive, MAX_ENTRIES, limits.unpacked, CaptureError)
        self.manifest = self._read_manifest()
        self._check_manifest()

    def read(self, entry: str) -> bytes:
        """The bytes of an entry.

        Raises
        ------
        CaptureError
            If it is missing, too large, or damaged.
        """
        info = self._entries.get(entry)
        if info is None:
            raise CaptureError(f"{entry} is not in the archive", entry=entry)
        return zip_files.read(self._archive, info, self._limits.image_bytes, CaptureError)

    @contextmanager
    def open(self, entry: str) -> Iterator[BinaryIO]:
        """Open an entry as a seekable file, for what is too large to read at once.

        A stored entry is read in place; a compressed one is unpacked into a temporary file.

        Raises
        ------
        CaptureError
            If it is damaged.
        """
        info = self._entries[entry]
        with ExitStack() as stack:
            try:
                with self._archive.open(info) as packed:
                    if info.compress_type == zipfile.ZIP_STORED:
                        # zipfile's own file seeks backwards by reading everything again from the start.
                        self._file.seek(info.header_offset + NAME_LENGTH_AT)
                        name, extra = struct.unpack("<HH", self._file.read(4))
                        start = info.header_offset + NAME_LENGTH_AT + 4 + name + extra
                        file = cast(BinaryIO, _Window(self._file, start, info.file_size))
                    else:
                        file = cast(BinaryIO, stack.enter_context(tempfile.TemporaryFile()))
                        for done in range(0, info.file_size, PIECE):
                            file.write(packed.read(min(PIECE, info.file_size - done)))
                        file.seek(0)
            except zip_files.UNREADABLE as error:
                raise CaptureError(
                    f"{entry} is damaged in the archive: make the archive again", entry=entry
                ) from error
            yield file

    def _read_manifest(self) -> Manifest:
        info = self._entries.get(MANIFEST)
        if info is None:
            nested = next((one for one in self._entries if one.endswith(f"/{MANIFEST}")), None)
            if nested is not None:
                why = f"{nested} must be at the root of the archive: put in what is in that folder, and not the folder"
            elif MATTE in self._entries:
                why = "this is the archive of a matte: import it, with `envmatte import` or in the web app"
            else:
                why = (
                    f"there is no {MANIFEST} at the root of the archive: make it of the film or the stills with "
                    "`envmatte pack`, or drop these in the web app as they are, without a ZIP"
                )
            raise CaptureError(why, entry=MANIFEST)
        if info.file_size > MANIFEST_BYTES:
            raise CaptureError(
                f"{MANIFEST} is larger than {MANIFEST_BYTES} bytes", entry=MANIFEST, limit=MANIFEST_BYTES
            )
        return parse_manifest(self.read(MANIFEST))

    def _check_manifest(self) -> None:
        """Check what the models cannot: frames or a video, files that exist, and a frame for every pattern."""
        manifest = self.manifest
        if manifest.video is not None and manifest.frames:
            raise CaptureError(
                f"{MANIFEST} names both frames and a video: give one of them", entry=MANIFEST, field="video"
            )
        if manifest.video is None and not manifest.frames:
            raise CaptureError(f"{MANIFEST} names no frames", entry=MANIFEST, field="frames")
        count = manifest.program.count
        # Recovery takes memory for every pattern, whether an unfinished capture has a frame of it or not.
        self._limits.check_frames(max(len(manifest.frames), count), entry=MANIFEST, field="frames")
        self._check_files_exist()
        for n, frame in enumerate(manifest.frames):
            if frame.pattern >= count:
                raise CaptureError(
                    f"{frame.file} shows pattern {frame.pattern}, but the program's patterns are 0 to {count - 1}",
                    entry=frame.file,
                    field=f"frames.{n}.pattern",
                )
        if manifest.video is not None:
            return
        shown = sorted({frame.pattern for frame in manifest.frames})
        missing = np.setdiff1d(np.arange(count), shown)
        if len(missing) and not manifest.unfinished:
            raise CaptureError(
                f"{len(missing)} of {count} patterns have no frame, the first of them pattern {missing[0]}; if the "
                "program has not been shown to its end, the capture is `unfinished`",
                entry=MANIFEST,
                field="frames",
            )
        if len(missing) and not manifest.program.tells(shown):
            raise CaptureError(
                "an unfinished capture needs frames of two different constant levels, and of a pattern that is neither "
                "constant nor half-tone",
                entry=MANIFEST,
                field="frames",
            )

    def _check_files_exist(self) -> None:
        manifest = self.manifest
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


class _Window:
    """Part of a file as a read-only file of its own."""

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
