"""`envmatte keys`: what it refuses."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main


def test_names_that_cannot_be_made_or_revoked_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ENVMATTE_DATA", str(tmp_path))
    assert CliRunner().invoke(main, ["keys", "make", "lab"]).stdout.startswith("envmatte_")
    for words, reason in (
        (("make", "lab"), "revoke it first"),
        (("make", "x" * 65), "1 to 64 characters"),
        (("revoke", "none"), "envmatte keys list"),
    ):
        refused = CliRunner().invoke(main, ["keys", *words])
        assert (refused.exit_code, reason in refused.stderr) == (1, True), refused.stderr


def test_a_key_says_which_database_has_it_and_who_does_not_see_what(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = CliRunner().invoke(main, ["keys", "make", "lab", "--owner", "alice"])
    assert str(tmp_path / "envmatte-data" / "envmatte.db") in made.stderr
    assert "belongs to 'default', and 'alice' does not see it" in made.stderr
    assert made.stdout.count("\n") == 1
    assert CliRunner().invoke(main, ["keys", "list"]).stdout.startswith("lab\talice")


def test_revoking_the_last_key_says_that_requests_still_need_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("lab", "home"):
        CliRunner().invoke(main, ["keys", "make", name])
    first, last = (CliRunner().invoke(main, ["keys", "revoke", name]) for name in ("lab", "home"))
    assert (first.stderr, last.stdout) == ("", "home: revoked\n")
    assert "requests still need one: `envmatte keys make NAME`" in last.stderr


@pytest.mark.parametrize("words", [("list",), ("revoke", "lab")])
def test_no_database_is_made_to_look_for_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(main, ["keys", *words])
    assert (refused.exit_code, "there is no database" in refused.stderr) == (1, True), refused.stderr
    assert list(tmp_path.iterdir()) == []
