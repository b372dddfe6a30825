"""`envmatte verify`, `backup` and `restore`: what they refuse."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("backup", "ftp://x/y"), "give it as a folder, or as s3://BUCKET/PREFIX"),
        (("backup", "target", "--data", "none"), "there is no database"),
        (("verify", "--data", "none"), "there is no database"),
        (("restore", "none", "--data", "new"), "there is no folder"),
    ],
)
def test_invalid_arguments_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code in (1, 2)
    assert reason in " ".join(done.stderr.split())
    assert done.stdout == ""
    assert not (tmp_path / "none").exists()
