"""Untrusted ZIP archives: entries that could do harm are refused by the directory, which names them."""

import io
import stat
import zipfile
from collections.abc import Callable

import pytest

from storage.errors import CaptureError
from workflows.untrusted import zip_files

Zip = Callable[..., bytes]
FILES = {f"{n}.png": b"a picture" for n in range(5)}


def refused(data: bytes) -> CaptureError:
    archive = zip_files.open_archive(io.BytesIO(data), CaptureError)
    with pytest.raises(CaptureError) as caught:
        zip_files.entries(archive, 100, 1 << 20, CaptureError)
    return caught.value


@pytest.mark.parametrize(
    "name",
    [
        "../x.png",
        "frames/../../x.png",
        "..",
        "/etc/x.png",
        "\\x.png",
        "..\\x.png",
        "a\\..\\..\\x",
        "C:\\x.png",
        "c:x",
    ],
)
def test_entries_that_leave_the_archive_are_refused(make_zip: Zip, name: str) -> None:
    error = refused(make_zip({}, FILES | {name: b"data"}))
    assert error.fields == {"entry": name}
    assert "leaves the archive" in error.detail


@pytest.mark.parametrize("name", ["a\nb.png", "a\x1b[2J.png", "a\x7f", "a\x9b31m.png"])
def test_entries_with_control_characters_are_refused(make_zip: Zip, name: str) -> None:
    error = refused(make_zip({}, FILES | {name: b"data"}))
    assert error.fields == {"entry": name}
    assert error.detail == f"{name!r} has control characters: rename the file"


def test_links_are_refused(make_zip: Zip) -> None:
    target = io.BytesIO(make_zip({}, FILES))
    with zipfile.ZipFile(target, "a") as archive:
        link = zipfile.ZipInfo("link.png")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    error = refused(target.getvalue())
    assert error.fields == {"entry": "link.png"}
    assert "link" in error.detail


def test_encrypted_entries_are_refused(make_zip: Zip) -> None:
    data = bytearray(make_zip({}, FILES))
    at = data.rindex(b"PK\x01\x02")
    data[at + 8] |= 1
    assert "without a password" in refused(bytes(data)).detail
    assert refused(bytes(data)).fields == {"entry": "4.png"}


@pytest.mark.parametrize("pack", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_packing_is_refused(make_zip: Zip, pack: int) -> None:
    assert "deflate" in refused(make_zip({}, FILES, pack)).detail


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", ["1.png", "capture.json"])
def test_names_given_twice_are_refused(make_zip: Zip, name: str) -> None:
    target = io.BytesIO(make_zip({}, FILES))
    with zipfile.ZipFile(target, "a") as archive:
        archive.writestr(name, b"another")
    error = refused(target.getvalue())
    assert error.fields == {"entry": name}
    assert "twice" in error.detail
