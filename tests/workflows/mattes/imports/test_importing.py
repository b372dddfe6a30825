"""A matte that comes in an archive: the same bytes as before, and nothing of one that lies."""

import io
import json
import stat
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from storage.errors import ArchiveError, OverLimit
from storage.layout.matte_archive import MANIFEST, Archive
from storage.objects.store import Objects
from tests.workflows.mattes.imports.conftest import (
    LIMITS,
    Files,
    checked,
    digests,
    documented,
    pack_chunk,
    packed,
    signed,
    unpack_chunk,
    unpacked,
)
from workflows.composite import composite
from workflows.mattes.imports import reader
from workflows.mattes.imports.importing import take_in
from workflows.untrusted.limits import Limits

BACKDROP = np.linspace(0, 1, 5 * 40 * 3, dtype=np.float32).reshape(5, 40, 3)
Change = Callable[[Files], None]


def bring(objects: Objects, archive: bytes, limits: Limits = LIMITS) -> None:
    take_in(io.BytesIO(archive), objects, "n", limits)


def refused(objects: Objects, archive: bytes, match: str, limits: Limits = LIMITS) -> ArchiveError:
    with pytest.raises(ArchiveError, match=match) as caught:
        bring(objects, archive, limits)
    assert objects.paths_below("mattes/n") == set()
    return caught.value


def chunk(files: Files, name: str, dtype: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(unpack_chunk(files[name]), dtype).copy()


def changed(name: str, dtype: str, change: Callable[[np.ndarray[Any, Any]], Any]) -> Change:
    """Changes the values of a chunk; in place, or into what is returned."""

    def apply(files: Files) -> None:
        values = chunk(files, name, dtype)
        other = change(values)
        files[name] = pack_chunk((values if other is None else other).tobytes())

    return apply


def put(at: int, value: float) -> Callable[[np.ndarray[Any, Any]], None]:
    return lambda values: values.__setitem__(at, value)


def test_imported_matte_exports_to_the_same_bytes(objects: Objects, folder: Path, archive: bytes) -> None:
    bring(objects, archive)
    assert digests(folder / "mattes/n") == digests(folder / "mattes/m")
    again = Archive(objects, "n")
    assert b"".join(again) == archive
    assert again.size == len(archive)


def test_imported_matte_composites_as_before(objects: Objects, archive: bytes, matte: Any) -> None:
    there = take_in(io.BytesIO(archive), objects, "n", LIMITS)
    np.testing.assert_array_equal(composite(there, BACKDROP), composite(matte, BACKDROP))


def test_repacked_archive_is_accepted(objects: Objects, folder: Path, archive: bytes) -> None:
    files = unpacked(archive)
    shuffled = {name: files[name] for name in sorted(files, reverse=True)}
    bring(objects, packed(shuffled, zipfile.ZIP_DEFLATED))
    assert digests(folder / "mattes/n") == digests(folder / "mattes/m")


def test_archive_without_checksums_is_imported_with_checksums(
    objects: Objects, folder: Path, archive: bytes
) -> None:
    files = unpacked(archive)
    for name in files:
        if name.endswith("zarr.json"):
            documented(name, lambda d: d.update({"codecs": d["codecs"][:-1]} if "codecs" in d else {}))(files)
        elif name != MANIFEST:
            files[name] = files[name][:-4]
    bring(objects, signed(files))
    assert digests(folder / "mattes/n") == digests(folder / "mattes/m")


@pytest.mark.parametrize("name", ["rho/c/0/0/0", "T/1.1/cell/c/0", "zarr.json", "T/0.0/weight/zarr.json"])
def test_data_damaged_before_the_export_is_refused(objects: Objects, archive: bytes, name: str) -> None:
    files = unpacked(archive)
    at = len(files[name]) // 2
    files[name] = files[name][:at] + bytes([files[name][at] ^ 1]) + files[name][at + 1 :]
    refused(objects, signed(files), rf"^{name}: (its checksum does not match|it is no JSON)")


def rolled(files: Files) -> None:
    """The cells of a row in another order."""
    counts = chunk(files, "count/c/0/0/0", "<u4")
    row = int(np.flatnonzero(counts > 1)[0])
    first = int(counts[:row].sum())

    def swap(cells: np.ndarray[Any, Any]) -> None:
        cells[first : first + 2] = cells[[first + 1, first]]

    changed("T/0.0/cell/c/0", "<u4", swap)(files)


def left_out_with_cells(files: Files) -> None:
    recovered = chunk(files, "recovered/c/0/0", "u1")
    counts = chunk(files, "count/c/0/0/0", "<u4").reshape(-1, 3)
    recovered[np.flatnonzero(counts.any(axis=1))[0]] = 0
    files["recovered/c/0/0"] = pack_chunk(recovered.tobytes())


def shared_with_others(files: Files) -> None:
    shared = chunk(files, "shared/c/0/0", "u1")
    counts = chunk(files, "count/c/0/0/0", "<u4").reshape(-1, 3)
    shared[np.flatnonzero(counts[:, 1:].any(axis=1))[0]] = 1
    files["shared/c/0/0"] = pack_chunk(shared.tobytes())


def a_bomb(files: Files) -> None:
    files["S/c/0/0/0"] = pack_chunk(bytes(1 << 27))


def removed(name: str) -> Change:
    return lambda files: files.__delitem__(name) or None


def added(name: str, data: bytes = b"{}") -> Change:
    return lambda files: files.update({name: data})


def attributes(**values: Any) -> Change:
    return documented("zarr.json", lambda d: d["attributes"].update(values))


def beside(wide: float = 1.0, away: float = 0.0) -> dict[str, Any]:
    return {"sight": [[wide, 0.0, 0.0], [0.0, 1.0, 0.0], [away, 0.0, 1.0]], "rho": [1.0, 1.0, 1.0]}


def codec(document: dict[str, Any]) -> None:
    document["codecs"][1] = {"name": "gzip", "configuration": {"level": 5}}


WHOLE: dict[str, tuple[str, str, Change]] = {
    "group of another name": ("T/9.9/zarr.json", "nothing that a matte", added("T/9.9/zarr.json")),
    "file": ("evil.py", "nothing that a matte", added("evil.py")),
    "chunk beyond the frame": ("S/c/0/3/0", "nothing that a matte", added("S/c/0/3/0")),
    "no chunk": ("rho/c/1/1/0", "not in the archive", removed("rho/c/1/1/0")),
    "no rows": ("T/1.1/cell/c/0", "counts add up", removed("T/1.1/cell/c/0")),
    "rows of none": ("T/0.1/cell/c/0", "counts add up to 0", added("T/0.1/cell/c/0")),
    "no root": ("zarr.json", "not in the archive", removed("zarr.json")),
    "no array": ("S/zarr.json", "not in the archive", removed("S/zarr.json")),
    "shape": (
        "S/zarr.json",
        "does not describe",
        documented("S/zarr.json", lambda d: d.update(shape=[9, 9, 3])),
    ),
    "shape of rows": (
        "T/0.0/cell/zarr.json",
        "does not describe",
        documented("T/0.0/cell/zarr.json", lambda d: d.update(shape=[1 << 60])),
    ),
    "chunk shape": (
        "rho/zarr.json",
        "does not describe",
        documented("rho/zarr.json", lambda d: d["chunk_grid"]["configuration"].update(chunk_shape=[1, 1, 3])),
    ),
    "dtype": (
        "S/zarr.json",
        "does not describe",
        documented("S/zarr.json", lambda d: d.update(data_type="float64")),
    ),
    "codec": ("S/zarr.json", "does not describe", documented("S/zarr.json", codec)),
    "codec of rows": (
        "T/0.0/weight/zarr.json",
        "does not describe",
        documented("T/0.0/weight/zarr.json", codec),
    ),
    "group as array": (
        "T/zarr.json",
        "does not describe",
        documented("T/zarr.json", lambda d: d.update(node_type="array")),
    ),
    "more attributes": ("zarr.json", "note", attributes(note="x")),
    "format": ("zarr.json", "format", attributes(format="envmatte-matte/9")),
    "huge": ("zarr.json", "height", attributes(height=1 << 40)),
    "none": ("zarr.json", "width", attributes(width=0)),
    "text": ("zarr.json", "width", attributes(width="35")),
    "a float": ("zarr.json", "width", attributes(width=35.0)),
    "large": ("zarr.json", "35 x 60000 pixels", attributes(height=60000)),
    "grid": ("zarr.json", "16384 x 16384 cells", attributes(columns=16384, rows=16384)),
    "block": ("zarr.json", "blocks of 64", attributes(block=64)),
    "crosstalk": ("zarr.json", "crosstalk", attributes(crosstalk=[[1, 0], [0, 1]])),
    "much crosstalk": ("zarr.json", "crosstalk", attributes(crosstalk=[[1e30, 0, 0]] * 3)),
    "a frame that looks away": ("zarr.json", "does not face", attributes(beside=beside(away=-2))),
    "a monitor far away": ("zarr.json", "too small", attributes(beside=beside(wide=100))),
    "more beside": ("zarr.json", "beside", attributes(beside={**beside(), "more": 1})),
    "grey light": ("zarr.json", "colours", attributes(crosstalk=[[1, 1, 1]] * 3)),
    "nested options": ("zarr.json", "options", attributes(options={"method": {"x": [1]}})),
    "many options": ("zarr.json", "options", attributes(options={str(n): n for n in range(1000)})),
    "another size": ("envmatte.json", "another matte", attributes(height=21)),
    "attributes of nothing": (
        "zarr.json",
        "attributes|format",
        documented("zarr.json", lambda d: d.pop("attributes")),
    ),
    "no object": ("zarr.json", "checksum", lambda files: files.update({"zarr.json": b"[1]"})),
    "no JSON": ("zarr.json", "no JSON", lambda files: files.update({"zarr.json": b"{"})),
    "deep JSON": ("zarr.json", "no JSON", lambda files: files.update({"zarr.json": b"[" * 60_000})),
    "long JSON": ("zarr.json", "65536", lambda files: files.update({"zarr.json": b" " * 70_000})),
    "NaN in JSON": (
        "zarr.json",
        "no JSON",
        lambda files: files.update({"zarr.json": b'{"attributes": NaN}'}),
    ),
    "bomb": ("S/c/0/0/0", "no chunk of 3072 bytes|allowed", a_bomb),
    "short": ("S/c/0/0/0", "unpacks to 3068", changed("S/c/0/0/0", "<f4", lambda v: v[:-1])),
    "long": ("S/c/0/0/0", "no chunk of 3072", changed("S/c/0/0/0", "<f4", lambda v: np.append(v, v[:1]))),
    "empty": ("S/c/0/0/0", "checksum", lambda files: files.update({"S/c/0/0/0": b""})),
    "packed otherwise": (
        "S/c/0/0/0",
        "no chunk",
        lambda files: files.update({"S/c/0/0/0": checked(bytes(100))}),
    ),
    "S of NaN": ("S/c/0/0/0", "not a number", changed("S/c/0/0/0", "<f4", put(0, np.nan))),
    "rho of inf": ("rho/c/0/0/0", "infinite", changed("rho/c/0/0/0", "<f4", put(9, np.inf))),
    "error of NaN": ("error/c/0/0", "not a number", changed("error/c/0/0", "<f4", put(5, np.nan))),
    "error below 0": ("error/c/0/0", "negative", changed("error/c/0/0", "<f4", put(5, -0.1))),
    "a third truth": ("recovered/c/0/0", "neither", changed("recovered/c/0/0", "u1", put(3, 2))),
    "counts": ("T/0.0/cell/zarr.json", "does not describe", changed("count/c/0/0/0", "<u4", lambda v: v + 1)),
    "counts of billions": (
        "count/c/0/0/0",
        "more than the 16384",
        changed("count/c/0/0/0", "<u4", put(0, 2**32 - 1)),
    ),
    "left out with cells": ("count/c/0/0/0", "left out", left_out_with_cells),
    "shared with others": ("count/c/0/0/0", "share", shared_with_others),
    "cell beyond": ("T/0.0/cell/c/0", "beyond the 260", changed("T/0.0/cell/c/0", "<u4", put(-1, 260))),
    "cells that descend": ("T/0.0/cell/c/0", "ascend", rolled),
    "cells of fewer": ("T/0.0/cell/c/0", "unpacks to", changed("T/0.0/cell/c/0", "<u4", lambda v: v[:-1])),
    "weight of NaN": ("T/0.0/weight/c/0", "positive", changed("T/0.0/weight/c/0", "<f4", put(0, np.nan))),
    "weight of inf": ("T/0.0/weight/c/0", "positive", changed("T/0.0/weight/c/0", "<f4", put(0, np.inf))),
    "weight below 0": ("T/0.0/weight/c/0", "positive", changed("T/0.0/weight/c/0", "<f4", put(0, -1))),
    "weights of 2": ("T/1.2/weight/c/0", "add up to 1", changed("T/1.2/weight/c/0", "<f4", lambda v: 2 * v)),
    "manifest of another format": (
        MANIFEST,
        "format",
        documented(MANIFEST, lambda d: d.update(format="envmatte-archive/2")),
    ),
    "manifest of another matte": (
        MANIFEST,
        "another matte",
        documented(MANIFEST, lambda d: d["matte"].update(width=36)),
    ),
    "manifest of more": (MANIFEST, "id", documented(MANIFEST, lambda d: d.update(id="x"))),
}


@pytest.mark.parametrize("case", WHOLE)
def test_false_entry_is_refused_by_name(objects: Objects, archive: bytes, case: str) -> None:
    entry, match, change = WHOLE[case]
    files = unpacked(archive)
    change(files)
    error = refused(objects, signed(files), match)
    assert error.fields["entry"] == entry
    assert entry in error.detail


def no_manifest(files: Files) -> None:
    del files[MANIFEST]


MANIFESTS: dict[str, tuple[str, Change]] = {
    "another byte": ("checksum", lambda files: files.update({"S/c/0/0/0": files["rho/c/0/0/0"]})),
    "unlisted": ("do not agree", added("S/c/9/9/9")),
    "only listed": ("do not agree", removed("T/0.0/zarr.json")),
    "another size": (
        "do not agree",
        documented(MANIFEST, lambda d: d["members"]["S/zarr.json"].update(size=3)),
    ),
    "another checksum": (
        "checksum",
        documented(MANIFEST, lambda d: d["members"]["S/zarr.json"].update(sha256="0" * 64)),
    ),
    "no checksum": ("sha256", documented(MANIFEST, lambda d: d["members"]["S/zarr.json"].update(sha256="x"))),
    "no manifest": ("not in the archive", no_manifest),
    "no JSON": ("no JSON", lambda files: files.update({MANIFEST: b"\xff"})),
    "half a character": (
        "no JSON",
        lambda files: files.update({MANIFEST: files[MANIFEST].replace(b'"S/zarr', b'"\\ud800')}),
    ),
    "more than it may say": (
        "more than 20 fields",
        documented(MANIFEST, lambda d: d.update({str(n): 0 for n in range(20)})),
    ),
    "more of an entry than it may say": (
        "more than 20 fields",
        documented(MANIFEST, lambda d: d["members"]["S/zarr.json"].update({str(n): 0 for n in range(20)})),
    ),
    "lists of nothing": (
        "more than .* parts",
        lambda files: files.update({MANIFEST: b"[" + b"[]," * 500 + b"0]"}),
    ),
    "a list": (MANIFEST, lambda files: files.update({MANIFEST: b"[]"})),
}


@pytest.mark.parametrize("case", MANIFESTS)
def test_manifest_that_differs_from_the_archive_is_refused(
    objects: Objects, archive: bytes, case: str
) -> None:
    match, change = MANIFESTS[case]
    files = unpacked(archive)
    change(files)
    if case == "another byte":
        size = len(files["S/c/0/0/0"])
        documented(MANIFEST, lambda d: d["members"]["S/c/0/0/0"].update(size=size))(files)
    assert "entry" in refused(objects, packed(files), match).fields


def test_only_the_first_fault_of_the_manifest_is_reported(objects: Objects, archive: bytes) -> None:
    files = unpacked(archive)
    documented(MANIFEST, lambda d: d.update(members={name: {"size": -1} for name in d["members"]}))(files)
    error = refused(objects, packed(files), "members.*size")
    assert isinstance(error.__cause__, ValidationError)
    assert error.__cause__.error_count() == 2  # of one entry


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("../S/zarr.json", "leaves"),
        ("/zarr.json", "leaves"),
        ("C:zarr.json", "leaves"),
        ("S\\..\\..\\x", "leaves"),
    ],
)
def test_names_that_leave_the_archive(objects: Objects, archive: bytes, name: str, match: str) -> None:
    assert refused(objects, signed(unpacked(archive) | {name: b"x"}), match).fields["entry"]


def test_links_and_duplicate_names_are_refused(objects: Objects, archive: bytes) -> None:
    for mode, match in ((stat.S_IFLNK, "link"), (stat.S_IFREG, "twice")):
        target = io.BytesIO(archive)
        info = zipfile.ZipInfo("zarr.json")
        info.external_attr = (mode | 0o777) << 16
        with zipfile.ZipFile(target, "a") as file, pytest.warns(UserWarning, match="Duplicate"):
            file.writestr(info, b"/etc/passwd")
        error = refused(objects, target.getvalue(), match)
        assert error.fields["entry"] == "zarr.json"


def test_too_many_entries_are_refused(objects: Objects, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "ENTRIES", 20)
    refused(objects, packed({str(n): b"" for n in range(21)}), "21 entries, more than 20")


def test_archive_that_unpacks_to_too_much_is_refused(objects: Objects, archive: bytes) -> None:
    error = refused(objects, archive, "more than the 20000 allowed", Limits(20_000, 1 << 20))
    assert error.fields["limit"] == 20_000
    files = unpacked(archive)
    files["S/c/0/0/0"] = bytes(1 << 21)
    refused(objects, packed(files, zipfile.ZIP_DEFLATED), "unpacks to 2.* bytes, more than the 1048576")
    # What its entries unpack to counts, and then what its chunks do.
    sizes = sum(map(len, unpacked(archive).values()))
    refused(objects, archive, "the matte unpacks to more", Limits(max(sizes, 42 * 20 * 35), 1 << 20))


def test_no_archive_at_all(objects: Objects, archive: bytes) -> None:
    for data in (b"", b"PK", json.dumps({}).encode(), archive[:-10], archive[: len(archive) // 2]):
        refused(objects, data, "not a ZIP archive")


def test_frame_with_more_pixels_than_allowed_is_refused(objects: Objects, archive: bytes) -> None:
    with pytest.raises(OverLimit, match="a frame may have 9 pixels") as caught:
        bring(objects, archive, replace(LIMITS, pixels=9))
    assert caught.value.fields["entry"] == "zarr.json"
    assert objects.paths_below("mattes/n") == set()
