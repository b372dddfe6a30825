"""The data folder: who can enter it, and where it can't be written to."""

import errno
import os
import stat
from pathlib import Path

import pytest

from services.runtime.data_folder import lock_data, make_data
from storage.errors import Conflict, Unavailable


def test_a_new_folder_is_its_owners_alone(tmp_path: Path) -> None:
    make_data(tmp_path / "new" / "data")
    assert stat.S_IMODE((tmp_path / "new" / "data").stat().st_mode) == 0o700


def test_a_file_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(Conflict, match="is a file: name a folder with --data"):
        make_data(file)
    assert not caplog.text


def test_rights_to_an_old_folder_are_left_alone_and_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.chmod(0o750)
    make_data(tmp_path)
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o750
    assert f"chmod 700 {tmp_path}" in caplog.text
    caplog.clear()
    tmp_path.chmod(0o700)
    make_data(tmp_path)
    assert not caplog.text


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*given: object, **options: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(Path, "open", refuse)
    message = r"can't write to .* \(read-only file system\): name another folder with --data"
    with pytest.raises(Unavailable, match=message):
        make_data(tmp_path / "new")
    with pytest.raises(Unavailable, match=message), lock_data(tmp_path):
        pass
