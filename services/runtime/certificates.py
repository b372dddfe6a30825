"""Certificates of a cluster: only processes with a copy of the folder can join it.

::

    ca.pem      the certificate of the cluster's own authority, whose key is not kept
    cert.pem    the only certificate that it signed, used by schedulers, workers and clients
    key.pem     its key: anyone with it can run arbitrary code on every machine of the cluster

To add a host, copy the folder to it. To renew the certificates, make a new folder and copy it to every host.
"""

import os
import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from storage.errors import Conflict, InvalidInput

if TYPE_CHECKING:
    from distributed.security import Security

CA, CERT, KEY = "ca.pem", "cert.pem", "key.pem"
LIFETIME = timedelta(days=3650)
SKEW = timedelta(days=1)
"""How far the clock of a host may be behind the clock of the host where the certificates were made."""


def make(certs: Path) -> bool:
    """Make the certificates of a cluster in a folder; returns False if it has a complete, valid set already.

    Raises
    ------
    Conflict
        If the folder has an incomplete or expired set, which is not overwritten.
    """
    there = [name for name in (CA, CERT, KEY) if (certs / name).exists()]
    if there:
        try:
            security_of(certs)
        except InvalidInput as error:
            raise Conflict(
                f"{certs} has {', '.join(there)} already, which can't be used and are not overwritten: "
                f"{error.detail}. Remove them first, or name another folder"
            ) from error
        return False
    made = _make()
    certs.mkdir(parents=True, exist_ok=True)
    # The key last: after an interrupt the set is incomplete, and is reported so.
    for file in (CA, CERT, KEY):
        _write(certs / file, made[file])
    return True


def new_security() -> "Security":
    """The TLS settings of a cluster whose certificates are in memory only, and gone with this process."""
    made = {name: data.decode() for name, data in _make().items()}
    return _security(made[CA], made[CERT], made[KEY])


def _make() -> dict[str, bytes]:
    """New certificates by their files' names."""
    authority, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "envmatte cluster")])
    issued = (
        _builder(
            x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "envmatte member")]), name, key, authority
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
            critical=False,
        )
    )
    root = (
        _builder(name, name, authority, authority)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(
            x509.KeyUsage(
                key_cert_sign=True,
                crl_sign=True,
                digital_signature=False,
                content_commitment=False,
                key_encipherment=False,
                data_encipherment=False,
                key_agreement=False,
                encipher_only=False,
                decipher_only=False,
            ),
            critical=True,
        )
    )
    return {
        CA: root.sign(authority, SHA256()).public_bytes(Encoding.PEM),
        CERT: issued.sign(authority, SHA256()).public_bytes(Encoding.PEM),
        KEY: key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
    }


def security_of(certs: Path) -> "Security":
    """The TLS settings of a member of a cluster, which accepts other members only.

    Parameters
    ----------
    certs : Path
        Folder made by `make`.

    Raises
    ------
    InvalidInput
        If a file is missing or unreadable, or belongs to another set, or the certificates have expired.
    """
    ca, cert, key = (str((certs / name).resolve()) for name in (CA, CERT, KEY))
    try:
        root, issued = (x509.load_pem_x509_certificate(Path(file).read_bytes()) for file in (ca, cert))
        issued.verify_directly_issued_by(root)
        ssl.create_default_context().load_cert_chain(cert, key)
    except OSError as error:  # ssl.SSLError too: the key is damaged, or belongs to another certificate
        reason = error.strerror if error.filename else "key.pem is not the key of cert.pem"
        raise _unusable(certs, f"{error.filename or key}: {reason}") from error
    except (ValueError, TypeError, InvalidSignature) as error:
        raise _unusable(certs, "they are damaged, or belong to different sets") from error
    now = datetime.now(UTC)
    for one in (root, issued):
        if not one.not_valid_before_utc <= now <= one.not_valid_after_utc:
            raise InvalidInput(
                f"the certificates in {certs} are valid from {one.not_valid_before_utc:%Y-%m-%d} to "
                f"{one.not_valid_after_utc:%Y-%m-%d}, and today is {now:%Y-%m-%d}: check the clock, or make "
                "new ones with `envmatte certs DIR` and copy them to every host of the cluster"
            )
    return _security(ca, cert, key)


def _security(ca: str, cert: str, key: str) -> "Security":
    """The TLS settings of a member of a cluster, from files' names or from their contents."""
    from distributed.security import Security  # with all of dask, which `envmatte certs` needs nothing of

    return Security(
        require_encryption=True,
        tls_ca_file=ca,
        **{f"tls_{role}_cert": cert for role in ("scheduler", "worker", "client")},
        **{f"tls_{role}_key": key for role in ("scheduler", "worker", "client")},
    )


def _unusable(certs: Path, reason: str) -> InvalidInput:
    return InvalidInput(
        f"the certificates in {certs} can't be used: {reason}. Make a folder with `envmatte certs DIR`, once for the "
        "whole cluster, and copy the whole folder to every host"
    )


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    authority: ec.EllipticCurvePrivateKey,
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + LIFETIME)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.public_key()), critical=False
        )
    )


def _write(path: Path, data: bytes) -> None:
    """Write a new file that only its owner can read; an existing one is never overwritten."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
