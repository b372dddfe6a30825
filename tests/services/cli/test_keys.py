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
