"""`envmatte verify`, `backup` and `restore`: what they refuse."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from storage import installation
from storage.database.engine import open_engine
from storage.objects.store import Objects


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


@pytest.mark.parametrize("command", [("verify",), ("backup", "target")])
def test_a_store_that_is_not_mounted_is_named_rather_than_all_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    engine = open_engine(f"sqlite:///{tmp_path}/envmatte.db")
    installation.recognise(engine, Objects((tmp_path / "store").as_uri()))
    engine.dispose()
    place = ("--data", str(tmp_path), "--store", (tmp_path / "unmounted").as_uri())
    done = CliRunner().invoke(main, (*command, *place))
    assert done.exit_code == 1
    assert "does not see the store of this installation" in done.stderr
    assert done.stdout == ""
    assert not (tmp_path / "unmounted").exists()
    assert not (tmp_path / "target").exists()
