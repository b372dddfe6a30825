"""Answers that wait in temporary files, and entity tags, as clients and proxies send them back."""

import tempfile
from pathlib import Path

import pytest
from starlette.datastructures import Headers

from services.api.http.responses import MEMORY_BYTES, bytes_response, etag_matches
from storage.errors import NoRoom
from tests.parts.disks import small_disk


@pytest.mark.parametrize(
    ("known", "matches"),
    [
        ('"abc"', True),
        ('W/"abc"', True),
        ('"other", W/"abc"', True),
        ("*", True),
        (" * ", True),
        ('"other"', False),
        ('W/"other"', False),
        ("abc", False),
        ('w/"abc"', False),
        ("", False),
    ],
)
def test_tags_are_compared_weakly(known: str, matches: bool) -> None:
    assert etag_matches(Headers({"If-None-Match": known}), '"abc"') == matches


def test_without_the_header_nothing_is_known() -> None:
    assert not etag_matches(Headers(), '"abc"')


def test_answer_on_disk_leaves_it_its_reserve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = 16 << 20
    with small_disk(tmp_path / "disk", size) as disk:
        monkeypatch.setattr(tempfile, "tempdir", str(disk))
        (disk / "ballast").write_bytes(bytes(size - MEMORY_BYTES - (64 << 10)))
        assert bytes_response(bytes(MEMORY_BYTES), "image/png").status_code == 200  # in memory
        with pytest.raises(NoRoom, match="the disk is full, apart from a reserve"):
            bytes_response(bytes(MEMORY_BYTES + 1), "image/png")
