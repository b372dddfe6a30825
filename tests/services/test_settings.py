"""The settings: from the environment, and what they refuse."""

import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from services.runtime import certificates as certificate_files
from services.settings import (
    GROUPS,
    ClusterSettings,
    SchedulerSettings,
    Settings,
    describe_settings,
    warn_of_unknown,
)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in Settings.model_fields:
        monkeypatch.delenv(f"ENVMATTE_{name.upper()}", raising=False)


def test_environment_and_env_file_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    Path(".env").write_text("ENVMATTE_PORT=9000\nENVMATTE_WORKERS=3\n")
    monkeypatch.setenv("ENVMATTE_WORKERS", "2")
    monkeypatch.setenv("ENVMATTE_KEYS", "one, two,")
    settings = Settings()
    assert (settings.port, settings.workers, settings.keys) == (9000, 2, ("one", "two"))
    assert Settings(workers=1).workers == 1


def test_empty_values_count_as_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    unset = Settings()
    Path(".env").write_text("ENVMATTE_STORE=\n")
    for name in Settings.model_fields:
        monkeypatch.setenv(f"ENVMATTE_{name.upper()}", "")
    assert Settings() == unset
    assert unset.webhook_secret is None


def test_every_setting_is_described_once() -> None:
    described = describe_settings()
    assert sorted(one.variable for one in described) == sorted(
        f"ENVMATTE_{name.upper()}" for name in Settings.model_fields
    )
    assert all(one.default and one.description.endswith(".") for one in described)
    assert list(dict.fromkeys(one.group for one in described)) == list(GROUPS)
    defaults = {one.variable: one.default for one in described}
    assert defaults["ENVMATTE_UPLOAD_BYTES"] == "8589934592 (8 GiB)"
    assert (defaults["ENVMATTE_COORDINATE"], defaults["ENVMATTE_OWNER_JOBS"]) == ("true", "no limit")


def test_a_process_has_only_the_settings_that_it_reads() -> None:
    described = [one.variable for one in describe_settings(SchedulerSettings)]
    assert described == ["ENVMATTE_DATA", "ENVMATTE_CERTS", "ENVMATTE_LOG", "ENVMATTE_LOG_LEVEL"]


def test_special_characters_of_a_path_are_escaped_in_its_url(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path / "a folder, 100 % ä")
    assert settings.store_url.startswith("file:///")
    assert " " not in settings.store_url


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": 70000},
        {"workers": 0},
        {"worker_memory": 150_000_000},
        {"ingest_memory": 5},
        {"attempts": 0},
        {"log": "xml"},
    ],
)
def test_values_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        Settings(**wrong)


def test_workers_have_what_they_need_by_default_or_no_limit() -> None:
    assert Settings(workers=100_000).worker_memory == 300_000_000
    assert Settings(worker_memory=0).worker_memory == 0


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certs") / "certs"
    certificate_files.make(folder)
    return folder


def test_no_setting_is_required_on_one_machine(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)
    assert settings.cluster is None
    assert settings.coordinate
    assert settings.database_url == f"sqlite:///{tmp_path}/envmatte.db"
    assert settings.store_url == f"file://{tmp_path}/store"
    assert settings.security() is None
    assert settings.worker_memory * settings.workers > 0


def test_a_cluster_is_named_with_its_database_and_store(certificates: Path) -> None:
    database, store = "postgresql://me:secret@db/envmatte", "s3://bucket/some/prefix"
    cluster = "tls://scheduler.example.org:8786"
    settings = Settings(cluster=cluster, certs=certificates, database=database, store=store)
    assert (settings.database_url, settings.store_url) == (database, store)
    security = settings.security()
    assert security is not None
    assert security.require_encryption


def test_certificates_are_looked_for_in_the_data_folder(certificates: Path, tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="--certs"):
        ClusterSettings(data=tmp_path, cluster="tls://192.0.2.1:8786")
    (tmp_path / "certs").symlink_to(certificates)
    found = ClusterSettings(data=tmp_path, cluster="tls://192.0.2.1:8786")
    assert found.certificates == tmp_path / "certs"
    assert ClusterSettings(data=tmp_path, cluster="tcp://127.0.0.1:8786").security() is None


@pytest.mark.parametrize("address", ["tcp://192.0.2.1:8786", "tcp://scheduler:8786", "tcp://0.0.0.0:8786"])
def test_a_cluster_without_tls_stays_on_loopback(address: str) -> None:
    with pytest.raises(ValidationError, match=r"Make certificates with `envmatte certs"):
        ClusterSettings(cluster=address)


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:8786", "tcp://localhost:8786", "tcp://127.0.0.9:1", "tcp://[::1]:8786"]
)
def test_on_loopback_a_cluster_needs_neither_tls_nor_a_store(address: str) -> None:
    assert Settings(cluster=address).cluster == address


@pytest.mark.parametrize(
    "address",
    ["scheduler:8786", "tls://", "tls://host", "http://127.0.0.1:80", "tcp://127.0.0.1:x", "", "tls:"],
)
def test_invalid_address_is_refused(address: str) -> None:
    with pytest.raises(ValidationError, match="tls://HOST:PORT"):
        ClusterSettings(cluster=address)


def test_certificates_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match=r"ca\.pem: No such file"):
        ClusterSettings(cluster="tls://192.0.2.1:8786", certs=tmp_path / "none")


def test_workers_elsewhere_need_a_shared_store(certificates: Path) -> None:
    with pytest.raises(ValidationError, match="--store"):
        Settings(cluster="tls://192.0.2.1:8786", certs=certificates)
    shared = Settings(cluster="tls://192.0.2.1:8786", certs=certificates, store="file:///shared")
    assert shared.store_url == "file:///shared"


@pytest.mark.parametrize(
    "wrong",
    [
        {"store": "gs://bucket"},
        {"store": "s3:///prefix"},
        {"store": "/shared"},
        {"store": "file://shared/store"},
        {"database": "mysql://me:secret@host/name"},
        {"database": "envmatte.db"},
        {"database": "sqlite://"},
        {"database": "sqlite:///:memory:"},
        {"database": "sqlite:///envmatte.db"},
    ],
)
def test_stores_and_databases_of_other_kinds_are_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))) as caught:
        Settings(**wrong)
    assert re.search("give it as|must be postgresql:|sqlite:////FILE", caught.value.errors()[0]["msg"])
    assert "secret" not in caught.value.errors()[0]["msg"]


def test_misspelt_variables_are_named_in_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("ENVMATTE_KEY", "ENVMATTE_URL", "ENVMATTE_LISTEN", "ENVMATTE_PORT"):
        monkeypatch.setenv(name, "1")
    warn_of_unknown()
    assert caplog.messages == []
    monkeypatch.setenv("ENVMATTE_STORE_BYTE", "1")
    monkeypatch.setenv("ENVMATTE_OWNERS_JOBS", "1")
    warn_of_unknown()
    (line,) = caplog.messages
    assert "ignored: ENVMATTE_OWNERS_JOBS, ENVMATTE_STORE_BYTE;" in line
