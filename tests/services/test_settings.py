"""The settings: from the environment, and what they refuse."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from services.settings import Settings


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in Settings.model_fields:
        monkeypatch.delenv(f"ENVMATTE_{name.upper()}", raising=False)


def test_the_environment_and_env_lines_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    Path(".env").write_text("ENVMATTE_PORT=9000\nENVMATTE_WORKERS=3\n")
    monkeypatch.setenv("ENVMATTE_WORKERS", "2")
    monkeypatch.setenv("ENVMATTE_KEYS", "one, two,")
    settings = Settings()
    assert (settings.port, settings.workers, settings.keys) == (9000, 2, ("one", "two"))
    assert Settings(workers=1).workers == 1


def test_paths_with_odd_names_make_urls_that_lead_back(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path / "a folder, 100 % ä")
    assert settings.store_url.startswith("file:///")
    assert " " not in settings.store_url


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])
def test_a_service_without_keys_stays_on_loopback(host: str) -> None:
    with pytest.raises(ValidationError, match="ENVMATTE_KEYS"):
        Settings(host=host)
    assert Settings(host=host, keys="a-key").host == host


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_no_key(host: str) -> None:
    assert Settings(host=host).keys == ()


@pytest.mark.parametrize("wrong", [{"port": 70000}, {"workers": 0}, {"ingest_memory": 5}, {"attempts": 0}])
def test_what_is_out_of_range_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        Settings(**wrong)
