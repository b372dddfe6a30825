"""The data folder: who can enter it."""

import stat
from pathlib import Path

import pytest

from services.runtime.data_folder import make_data
from storage.errors import Conflict


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
