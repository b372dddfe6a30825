"""Certificates of a cluster: made once, for its members only, with an error when they can't be used."""

import os
import stat
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from services.runtime import certificates
from storage.errors import Conflict, InvalidInput


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "deep" / "certs"
    assert certificates.make(made)
    return made


def test_only_the_owner_can_read_the_files(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["ca.pem", "cert.pem", "key.pem"]
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}


def test_the_key_of_the_authority_is_not_kept(folder: Path) -> None:
    authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    member = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
    key = load_pem_private_key((folder / "key.pem").read_bytes(), None)
    assert key.public_key() == member.public_key() != authority.public_key()
    member.verify_directly_issued_by(authority)
    for path in folder.iterdir():
        assert path.read_text().count("PRIVATE KEY") == (2 if path.name == "key.pem" else 0)


def test_dask_requires_these_certificates(folder: Path) -> None:
    security = certificates.security_of(folder)
    assert security.require_encryption
    for role in ("scheduler", "worker", "client"):
        config = security.get_tls_config_for_role(role)
        assert [Path(config[name]).name for name in ("ca_file", "cert", "key")] == [
            "ca.pem",
            "cert.pem",
            "key.pem",
        ]


def test_a_complete_set_is_not_replaced(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert not certificates.make(folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("missing", ["ca.pem", "cert.pem", "key.pem"])
def test_an_incomplete_set_is_neither_used_nor_overwritten(folder: Path, missing: str) -> None:
    (folder / missing).unlink()
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InvalidInput, match=f"{missing}.*envmatte certs"):
        certificates.security_of(folder)
    with pytest.raises(Conflict, match="not overwritten"):
        certificates.make(folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("mixed", ["ca.pem", "cert.pem", "key.pem"])
def test_files_of_two_sets_are_refused(folder: Path, tmp_path: Path, mixed: str) -> None:
    certificates.make(tmp_path / "other")
    os.replace(tmp_path / "other" / mixed, folder / mixed)
    with pytest.raises(InvalidInput, match="can't be used"):
        certificates.security_of(folder)


@pytest.mark.parametrize("damaged", ["ca.pem", "cert.pem", "key.pem"])
def test_damaged_files_are_refused(folder: Path, damaged: str) -> None:
    (folder / damaged).write_bytes((folder / damaged).read_bytes()[:100])
    with pytest.raises(InvalidInput, match="can't be used"):
        certificates.security_of(folder)


def test_expired_certificates_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certificates, "LIFETIME", timedelta(seconds=-1))
    certificates.make(tmp_path / "old")
    with pytest.raises(InvalidInput, match=r"valid from .* and today is .*envmatte certs"):
        certificates.security_of(tmp_path / "old")
    with pytest.raises(Conflict, match="Remove them"):
        certificates.make(tmp_path / "old")
