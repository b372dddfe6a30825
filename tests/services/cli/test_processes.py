"""Commands that use kernels, where this user can write to no folder for them."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from services.runtime.kernel_cache import require_kernel_cache


@pytest.mark.parametrize("command", ["serve", "coordinator", "worker", "warm"])
def test_user_without_a_folder_for_kernels_is_told_to_name_one(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "access", lambda *given: False)
    refused = CliRunner().invoke(main, [command])
    assert (refused.exit_code, "set NUMBA_CACHE_DIR" in refused.stderr) == (1, True), refused.stderr


def test_a_folder_that_is_still_to_be_made_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda folder, mode: folder == tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new" / "cache"))
    require_kernel_cache()
