"""Capture archives: every one is read or refused, and each refusal names the entry or field at fault."""

import copy
import io
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from storage.errors import CaptureError, OverLimit
from storage.layout import uploads
from storage.objects.store import Objects
from workflows.ingest.archive import MAX_ENTRIES, CaptureArchive
from workflows.untrusted.limits import MAX_FRAMES, Limits

Zip = Callable[..., bytes]
LIMITS = Limits(unpacked=1 << 20, memory=1 << 20)

MANIFEST: dict[str, Any] = {
    "format": "envmatte-capture/1",
    "name": "ball",
    "program": {
        "monitor": {"width": 64, "height": 48},
        "parts": [
            {"kind": "constant", "levels": [0, 1]},
            {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 2, "seed": 1},
            {"kind": "images", "files": ["shown/a.png"]},
        ],
    },
    "response": "linear",
    "frames": [{"file": f"frames/{n}.png", "pattern": n} for n in (2, 0, 1, 4, 3, 3)],
    "mask": "mask.png",
}
FILES = {
    name: name.encode() * 20 for name in ("shown/a.png", "mask.png", *(f"frames/{n}.png" for n in range(5)))
}


VIDEO = {"file": "clip.mp4", "patterns_per_second": 2.0}


def changed(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    manifest = copy.deepcopy(MANIFEST)
    change(manifest)
    return manifest


def open_archive(data: bytes, limits: Limits = LIMITS) -> CaptureArchive:
    return CaptureArchive(io.BytesIO(data), limits)


def refused(data: bytes, limits: Limits = LIMITS) -> CaptureError:
    with pytest.raises(CaptureError) as caught:
        open_archive(data, limits)
    assert caught.value.detail
    return caught.value


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("my film/capture.json", "my film/capture.json must be at the root"),
        ("zarr.json", "the archive of a matte"),
        ("film.mp4", "make it of the film or the stills with `envmatte pack`"),
    ],
)
def test_what_is_there_in_place_of_a_capture_is_named(name: str, why: str) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, "{}")
    assert why in refused(file.getvalue()).detail


@pytest.mark.parametrize("pack", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_archive_is_read(make_zip: Zip, pack: int) -> None:
    archive = open_archive(make_zip(MANIFEST, FILES, pack))
    assert archive.manifest.name == "ball"
    assert archive.manifest.program.count == 5
    assert next((f.file, f.pattern) for f in archive.manifest.frames) == ("frames/2.png", 2)
    for name, data in FILES.items():
        assert archive.read(name) == data


def test_patterns_of_an_unfinished_capture_may_lack_frames(make_zip: Zip) -> None:
    manifest = changed(lambda r: r.update(frames=r["frames"][:3], unfinished=True))
    assert [frame.pattern for frame in open_archive(make_zip(manifest, FILES)).manifest.frames] == [2, 0, 1]


def test_an_unfinished_capture_may_have_no_more_patterns_than_frames(make_zip: Zip) -> None:
    manifest = changed(lambda r: r.update(frames=r["frames"][:3], unfinished=True))
    data = make_zip(manifest, FILES)
    assert open_archive(data, replace(LIMITS, frames=5)).manifest.program.count == 5
    with pytest.raises(OverLimit, match="may have 4 frames or patterns, this one has 5"):
        open_archive(data, replace(LIMITS, frames=4))


def test_unknown_fields_and_files_are_accepted(make_zip: Zip) -> None:
    def extend(manifest: dict[str, Any]) -> None:
        manifest["made_by"] = {"tool": "x", "at": [1, 2]}
        manifest["frames"][0]["aperture"] = 5.6
        manifest["program"]["note"] = "text"
        manifest["program"]["monitor"]["serial"] = "7"
        manifest["program"]["parts"][1]["shuffled"] = False

    files = FILES | {"README.txt": b"hello", "empty/": b"", "ünï.png": b""}
    archive = open_archive(make_zip(changed(extend), files))
    assert archive.manifest == open_archive(make_zip(MANIFEST, FILES)).manifest


def test_as_many_frames_as_a_capture_may_have_fit_into_an_archive(make_zip: Zip) -> None:
    frames = [{"file": f"{n}.png", "pattern": n % 5} for n in range(MAX_FRAMES)]
    data = make_zip(MANIFEST | {"frames": frames}, FILES | {frame["file"]: b"" for frame in frames})
    archive = open_archive(data, Limits(unpacked=1 << 24, memory=1 << 24))
    assert len(archive.manifest.frames) == MAX_FRAMES


def test_archive_without_a_manifest_is_refused(make_zip: Zip) -> None:
    assert refused(make_zip(None, FILES)).fields == {"entry": "capture.json"}
    deeper = make_zip(None, {"ball/capture.json": b"{}"})
    assert refused(deeper).fields == {"entry": "capture.json"}


@pytest.mark.parametrize(
    ("change", "field", "why"),
    [
        (lambda r: r.pop("format"), "format", "required"),
        (lambda r: r.update(format="envmatte-capture/2"), "format", "envmatte-capture/1"),
        (lambda r: r.pop("program"), "program", "required"),
        (lambda r: r.update(response={"gamma": 99}), "response", ""),
        (lambda r: r.update(response="kodak"), "response", "linear"),
        (lambda r: r.update(name="x" * 201), "name", "200"),
        (lambda r: r.update(name="a\0b"), "name", "control characters"),
        (lambda r: r.update(name="a\r\nb"), "name", "control characters"),
        (lambda r: r["program"]["monitor"].update(width=0), "program.monitor.width", "must be at least 1"),
        (
            lambda r: r["program"]["parts"][0].update(levels=[0.5, 0.5]),
            "program",
            "no two different constant",
        ),
        (lambda r: r["program"]["parts"].pop(0), "program", "no two different constant"),
        (lambda r: r["program"]["parts"][1].update(columns=65), "program", "finer than the monitor"),
        (lambda r: r["program"]["parts"][1].pop("seed"), "program.parts.1.seed", "required"),
        (lambda r: r["program"]["parts"][1].update(kind="hadamard"), "program.parts.1", "kind"),
        (lambda r: r["frames"][3].update(pattern=-1), "frames.3.pattern", "must be at least 0"),
        (lambda r: r["frames"][3].update(pattern=5), "frames.3.pattern", "0 to 4"),
        (lambda r: r["frames"][3].update(pattern=10**30), "frames.3.pattern", ""),
        (lambda r: r["frames"][3].pop("file"), "frames.3.file", "required"),
        (lambda r: r["frames"][3].update(file="frames/9.png"), "frames.3.file", "frames/9.png"),
        (
            lambda r: r["frames"].pop(0),
            "frames",
            "1 of 5 patterns have no frame, the first of them pattern 2",
        ),
        (
            lambda r: r.update(frames=r["frames"][:1], unfinished=True),
            "frames",
            "two different constant levels",
        ),
        (lambda r: r.update(frames=r["frames"][1:3], unfinished=True), "frames", "neither constant"),
        (lambda r: r.update(frames=[]), "frames", "no frames"),
        (lambda r: r.update(mask="masks.png"), "mask", "masks.png"),
        (lambda r: r["program"]["parts"][2].update(files=["b.png"]), "program.parts.2.files.0", "b.png"),
        (lambda r: r.update(video=VIDEO), "video", "both frames and a video"),
        (lambda r: r.update(video=VIDEO, frames=[]), "video.file", "clip.mp4"),
        (lambda r: r.update(video={"file": "a.mp4"}), "video.patterns_per_second", "required"),
        (lambda r: r.update(video=VIDEO | {"patterns_per_second": 0}), "video.patterns_per_second", ""),
    ],
)
def test_inconsistent_manifest_is_refused(
    make_zip: Zip, change: Callable[[dict[str, Any]], object], field: str, why: str
) -> None:
    error = refused(make_zip(changed(change), FILES))
    assert str(error.fields["field"]).startswith(field)
    assert error.fields["entry"]
    assert why in error.detail


def test_folder_as_a_frame_is_refused(make_zip: Zip) -> None:
    manifest = changed(lambda r: r["frames"][0].update(file="frames/x/"))
    error = refused(make_zip(manifest, FILES | {"frames/x/": b""}))
    assert error.fields == {"entry": "frames/x/", "field": "frames.0.file"}


def test_a_zip_bomb_is_refused_by_its_directory(make_zip: Zip) -> None:
    bomb = make_zip(MANIFEST, FILES | {"frames/zeros.png": bytes(50 << 20)}, zipfile.ZIP_DEFLATED)
    assert len(bomb) < 100_000
    start = time.process_time()
    error = refused(bomb)
    assert error.fields == {"limit": 1 << 20}
    assert time.process_time() - start < 1
    many = {f"frames/{n}.dat": bytes(1 << 17) for n in range(8)}
    assert refused(make_zip(MANIFEST, FILES | many, zipfile.ZIP_DEFLATED)).fields == {"limit": 1 << 20}


def test_an_entry_takes_a_quarter_of_the_memory_at_most(make_zip: Zip) -> None:
    files = FILES | {"fits": bytes(1 << 18), "large": bytes((1 << 18) + 1)}
    archive = open_archive(make_zip(MANIFEST, files))
    assert len(archive.read("fits")) == 1 << 18
    with pytest.raises(CaptureError, match="more than the 262144") as caught:
        archive.read("large")
    assert caught.value.fields == {"entry": "large", "limit": 1 << 18}


def test_directory_with_false_sizes_takes_no_memory(make_zip: Zip) -> None:
    size = 100 << 20
    data = bytearray(make_zip(MANIFEST, FILES | {"z": bytes(size)}, zipfile.ZIP_DEFLATED))
    at = data.rindex(b"PK\x01\x02")
    assert struct.unpack_from("<I", data, at + 24) == (size,)
    struct.pack_into("<I", data, at + 24, 1000)
    archive = open_archive(bytes(data))
    tracemalloc.start()
    try:
        with pytest.raises(CaptureError, match="z is damaged"):
            archive.read("z")
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("field", "value"), [(20, 0), (20, 5), (24, 99), (42, 0xFFFFFFFE), (42, None)])
@pytest.mark.parametrize("pack", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_false_directory_is_refused_when_an_entry_is_read(
    make_zip: Zip, pack: int, field: int, value: int | None
) -> None:
    data = bytearray(make_zip(MANIFEST, FILES, pack))
    at = data.rindex(b"PK\x01\x02") + field
    # None: a few bytes into the entry itself; into another one, newer Pythons refuse that other one too.
    struct.pack_into("<I", data, at, struct.unpack_from("<I", data, at)[0] + 3 if value is None else value)
    archive = open_archive(bytes(data))
    with pytest.raises(CaptureError) as caught:
        archive.read("frames/4.png")
    assert caught.value.fields == {"entry": "frames/4.png"}
    assert archive.read("frames/3.png") == FILES["frames/3.png"]


def test_offset_beyond_the_file_is_refused(make_zip: Zip) -> None:
    data = make_zip(MANIFEST, FILES)
    at, end = data.rindex(b"PK\x01\x02"), data.rindex(b"PK\x05\x06")
    entry, extra = bytearray(data[at:end]), struct.pack("<HHQ", 1, 8, 2**64 - 1)
    struct.pack_into("<H", entry, 30, len(extra))
    struct.pack_into("<I", entry, 42, 0xFFFFFFFF)  # the offset stands in the ZIP64 field
    tail = bytearray(data[end:])
    struct.pack_into("<I", tail, 12, struct.unpack_from("<I", tail, 12)[0] + len(extra))
    archive = open_archive(data[:at] + bytes(entry) + extra + bytes(tail))
    with pytest.raises(CaptureError) as caught:
        archive.read("frames/4.png")
    assert caught.value.fields == {"entry": "frames/4.png"}


def test_missing_entry_is_refused(make_zip: Zip) -> None:
    with pytest.raises(CaptureError) as caught:
        open_archive(make_zip(MANIFEST, FILES)).read("none")
    assert caught.value.fields == {"entry": "none"}


def through(data: bytes, open_file: Callable[[bytes], Any]) -> int:
    """Reads all of a archive; 1 if some of it was refused. Any error but CaptureError fails the test."""
    try:
        with open_file(data) as file:
            archive = CaptureArchive(file, LIMITS)
            for name in FILES:
                archive.read(name)
    except CaptureError:
        return 1
    return 0


def test_an_archive_that_is_cut_off_is_refused(
    make_zip: Zip, objects: Objects, put: Callable[[str, bytes], None]
) -> None:
    data = make_zip(MANIFEST, FILES, zipfile.ZIP_DEFLATED)
    lengths = {*range(0, len(data), 37), *range(len(data) - 120, len(data), 3)}
    for length in lengths:
        assert through(data[:length], io.BytesIO), length
    for length in (0, 1, 21, 22, 500, len(data) - 30, len(data) - 1):
        put("cut", data[:length])
        assert through(b"", lambda _: uploads.read(objects, "cut")), length


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("pack", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_damaged_archive_is_a_capture_error_or_read(
    make_zip: Zip, objects: Objects, put: Callable[[str, bytes], None], pack: int
) -> None:
    whole = make_zip(MANIFEST, FILES, pack)
    assert through(whole, io.BytesIO) == 0
    directory = whole.index(b"PK\x01\x02")
    rng = np.random.default_rng(pack)
    refusals = 0
    for case in range(400):
        data = bytearray(whole)
        lowest = directory if case % 2 else 0
        for at in rng.integers(lowest, len(data), rng.integers(1, 6)):
            data[at] = rng.choice([0, 1, 255, rng.integers(256)])
        if case % 7 == 0:
            at = int(rng.integers(len(data)))
            data[at:at] = rng.bytes(9)
        start = time.process_time()
        refusals += through(bytes(data), io.BytesIO)
        if case % 20 == 0:
            put("damaged", bytes(data))
            through(b"", lambda _: uploads.read(objects, "damaged"))
        assert time.process_time() - start < 2
    assert refusals > 200


def test_a_directory_of_too_many_entries_is_refused(make_zip: Zip) -> None:
    files = FILES | {f"more/{n}": b"" for n in range(MAX_ENTRIES)}
    with pytest.raises(CaptureError, match=f"more than {MAX_ENTRIES}"):
        open_archive(make_zip(MANIFEST, files))


def test_directory_that_is_a_zip_bomb_is_not_read(make_zip: Zip) -> None:
    data = make_zip(MANIFEST, FILES | {f"{n:05d}" + 60_000 * "x": b"" for n in range(400)})
    tracemalloc.start()
    try:
        with pytest.raises(CaptureError, match="directory can't be read"):
            open_archive(data)
        assert tracemalloc.get_traced_memory()[1] < 12 << 20  # of 24 MB
    finally:
        tracemalloc.stop()


def test_an_entry_larger_than_a_directory_may_be_is_read(make_zip: Zip) -> None:
    large = bytes(range(256)) * (9 << 12)
    archive = CaptureArchive(
        io.BytesIO(make_zip(MANIFEST, FILES | {"large": large})), Limits(1 << 30, 1 << 30)
    )
    assert archive.read("large") == large


def test_manifest_over_its_limit_is_refused(make_zip: Zip) -> None:
    limits = Limits(unpacked=1 << 24, memory=1 << 24)
    error = refused(make_zip(b" " * ((4 << 20) + 1), FILES, zipfile.ZIP_DEFLATED), limits)
    assert error.fields == {"entry": "capture.json", "limit": 4 << 20}
