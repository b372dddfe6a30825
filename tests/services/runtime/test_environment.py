"""The environment: which variables and lines of .env count, and where the database is by them."""

import os
from pathlib import Path

import pytest

from services.runtime.environment import database_url, read_environment, unknown_variables
from storage.database.engine import open_engine

NAMES = {"port", "worker_memory"}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        monkeypatch.delenv(f"ENVMATTE_{name.upper()}", raising=False)


def test_a_variable_wins_over_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_environment(NAMES) == {}
    Path(".env").write_text("ENVMATTE_PORT=1\nENVMATTE_WORKER_MEMORY=2\nENVMATTE_OTHER=3\nPORT=4\n")
    monkeypatch.setenv("ENVMATTE_PORT", "5")
    assert read_environment(NAMES) == {"port": "5", "worker_memory": "2"}


def test_an_empty_value_counts_as_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    Path(".env").write_text("ENVMATTE_PORT=1\nENVMATTE_WORKER_MEMORY=\n")
    monkeypatch.setenv("ENVMATTE_PORT", "")
    assert read_environment(NAMES) == {"port": "1"}


def test_case_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("Envmatte_Port", "1")
    assert read_environment(NAMES) == {"port": "1"}


def test_what_is_no_setting_is_found_in_variables_and_file(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("ENVMATTE_")]:
        monkeypatch.delenv(name)
    Path(".env").write_text("ENVMATTE_PORT=1\nENVMATTE_WORKER_MEMROY=2\nPORT=4\nENVMATTE_EMPTY=\n")
    monkeypatch.setenv("ENVMATTE_STROE", "s3://bucket")
    assert unknown_variables(NAMES) == ["ENVMATTE_STROE", "ENVMATTE_WORKER_MEMROY"]


def test_the_database_is_in_the_data_folder_unless_named(tmp_path: Path) -> None:
    assert database_url(Path("data"), None) == f"sqlite:///{tmp_path}/data/envmatte.db"
    assert database_url(Path("data"), "postgresql://host/name") == "postgresql://host/name"


def test_the_database_is_in_a_data_folder_of_any_name(tmp_path: Path) -> None:
    data = tmp_path / "glass #1 %41?ü"
    data.mkdir()
    open_engine(database_url(data, None)).dispose()
    assert [*tmp_path.iterdir()] == [data]
    assert (data / "envmatte.db").is_file()
