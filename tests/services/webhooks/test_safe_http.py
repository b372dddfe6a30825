"""Requests to URLs from untrusted callers: which are refused, and how little of the answer is read."""

import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from hypothesis import given, settings
from hypothesis import strategies as st

from services.webhooks import safe_http
from storage.errors import OptionError
from tests.services.webhooks.receivers import receiver

PUBLIC = [
    "93.184.216.34",
    "1.1.1.1",
    "2606:4700:4700::1111",
    "::ffff:1.1.1.1",
    "64:ff9b::101:101",
    "2002:101:101::1",
    "2606:4700::5efe:101:101",
]
NOT_PUBLIC = [
    "0.0.0.0",
    "10.0.0.1",
    "100.64.0.1",
    "127.0.0.1",
    "127.9.9.9",
    "169.254.169.254",
    "172.16.0.1",
    "192.168.1.1",
    "198.18.0.1",
    "224.0.0.1",
    "239.255.255.250",
    "240.0.0.1",
    "255.255.255.255",
    "::",
    "::1",
    "::127.0.0.1",
    "::ffff:127.0.0.1",
    "::ffff:10.0.0.1",
    "::ffff:a9fe:a9fe",
    "64:ff9b::7f00:1",
    "64:ff9b:1::1",
    "2002:7f00:1::1",
    "2001:db8::1",
    "fc00::1",
    "fd12:3456::1",
    "fe80::1",
    "fe80::1%lo",
    "fec0::1",
    "ff02::1",
    "100::1",
    "192.0.0.8",
    "192.88.99.1",
    "3fff::1",
    "2606:4700::5efe:7f00:1",
    "2606:4700::200:5efe:a00:1",
    "fe80::5efe:101:101",
]
PRIVATE_URLS = [
    "https://127.0.0.1/",
    "https://127.0.0.1:8000/x",
    "https://2130706433/",
    "https://0x7f000001/",
    "https://0177.0.0.1/",
    "https://127.1/",
    "https://0/",
    "https://167772161/",
    "https://[::1]/",
    "https://[::ffff:127.0.0.1]/",
    "https://[::ffff:7f00:1]/",
    "https://[fd00::1]/",
    "https://localhost/",
    "https://localhost./",
    "https://a.LOCALHOST/",
]
MALFORMED = [
    "",
    "example.com",
    "ftp://example.com/",
    "file:///etc/passwd",
    "https://",
    "https:///x",
    "https://user@example.com/",
    "https://user:secret@example.com/",
    "https://example.com/#x",
    "https://example.com:99999/",
    "https://example.com:0/",
    "https://example.com/\r\nX: y",
    "https://example.com/ x",
    "https://exämple.com/",
    "https://[::1",
    "https://a..b/",
    "https://./",
    "https://" + "x" * 64 + ".com/",
    "https://[fe80::1%lo]/",
    "https://[fe80::1%25lo]/",
    "https://example.com/" + "x" * 2000,
]


def _has_ipv6() -> bool:
    with suppress(OSError), socket.create_server(("::1", 0), family=socket.AF_INET6):
        return True
    return False


IPV6 = _has_ipv6()


@pytest.mark.parametrize("address", PUBLIC)
def test_address_is_public(address: str) -> None:
    assert safe_http.is_public(address)


@pytest.mark.parametrize("address", NOT_PUBLIC)
def test_address_is_not_public(address: str) -> None:
    assert not safe_http.is_public(address)


@pytest.mark.parametrize("url", PRIVATE_URLS)
def test_url_of_private_address_is_refused_unless_allowed(url: str) -> None:
    with pytest.raises(OptionError, match="ENVMATTE_WEBHOOK_PRIVATE") as caught:
        safe_http.check_url(url, private=False)
    assert caught.value.fields == {"field": "webhook"}
    safe_http.check_url(url, private=True)


@pytest.mark.parametrize("url", MALFORMED)
@pytest.mark.parametrize("private", [False, True])
def test_malformed_url_is_refused(url: str, private: bool) -> None:
    with pytest.raises(OptionError, match="https://HOST"):
        safe_http.check_url(url, private=private)


def test_tls_is_required_unless_private_addresses_are_allowed() -> None:
    safe_http.check_url("https://example.com:8443/a?b=c", private=False)
    safe_http.check_url("http://example.com/", private=True)
    with pytest.raises(OptionError, match="https://HOST"):
        safe_http.check_url("http://example.com/", private=False)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "2130706433", "127.1"])
def test_nothing_connects_to_an_address_that_is_not_public(host: str) -> None:
    with receiver(lambda n: 200) as found:
        url = found.url.replace("127.0.0.1", host)
        with pytest.raises(safe_http.Refused, match="not public"):
            safe_http.post(url, b"x", {}, private=False)
        assert found.received == []
        assert safe_http.post(url, b"x", {"A": "b"}, private=True) == 200
    ((headers, body),) = found.received
    assert (headers["Host"].rpartition(":")[0], headers["A"], body) == (host, "b", b"x")


def test_name_with_one_private_address_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def both(*arguments: object, **options: object) -> list[tuple[object, ...]]:
        return [(2, 1, 6, "", ("93.184.216.34", 0)), (10, 1, 6, "", ("::1", 0, 0, 0))]

    monkeypatch.setattr(socket, "getaddrinfo", both)
    with pytest.raises(safe_http.Refused, match="::1, which is not public"):
        safe_http.post("https://example.com/", b"", {}, private=False)


def test_request_goes_to_the_address_that_was_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    real, lookups = socket.getaddrinfo, []

    def rebinding(host: str, *arguments: object, **options: object) -> object:
        if host == "rebinding.example":
            lookups.append(host)
            return real("127.0.0.1" if len(lookups) == 1 else "127.0.0.2", *arguments, **options)  # type: ignore[arg-type]
        return real(host, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(socket, "getaddrinfo", rebinding)
    with receiver(lambda n: 200) as found:
        url = found.url.replace("127.0.0.1", "rebinding.example")
        assert safe_http.post(url, b"x", {}, private=True) == 200
    assert len(lookups) == 1
    assert found.received[0][0]["Host"].startswith("rebinding.example:")


@given(
    st.one_of(st.ip_addresses().map(str), st.just("localhost")),
    st.sampled_from([("http", 80), ("https", 443)]),
    st.none() | st.integers(1, 65535),
)
@settings(deadline=None)  # looking up a name may take long
def test_request_goes_to_the_port_of_its_url_or_scheme(
    host: str, scheme: tuple[str, int], port: int | None
) -> None:
    connections: list[tuple[str, int]] = []

    def refuse(address: tuple[str, int], timeout: float) -> socket.socket:
        connections.append(address)
        raise ConnectionRefusedError

    url = f"{scheme[0]}://{f'[{host}]' if ':' in host else host}{f':{port}' if port else ''}/"
    safe_http.check_url(url, private=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket, "create_connection", refuse)
        with pytest.raises(ConnectionRefusedError):
            safe_http.post(url, b"x", {}, private=True)
    assert {found for _, found in connections} == {port or scheme[1]}


@pytest.mark.skipif(not IPV6, reason="this machine has no IPv6 loopback")
def test_request_to_an_ipv6_address() -> None:
    with receiver(lambda n: 200, host="::1") as found:
        assert safe_http.post(found.url, b"x", {}, private=True) == 200
    ((headers, body),) = found.received
    assert (headers["Host"], body) == (found.url.split("/")[2], b"x")


def test_redirect_is_not_followed() -> None:
    with receiver(lambda n: 200) as target, receiver(lambda n: 302, Location=target.url) as found:
        assert safe_http.post(found.url, b"x", {}, private=True) == 302
        assert target.received == []


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with a key and a self-signed certificate for localhost."""
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    file = tmp_path_factory.mktemp("certificate") / "localhost.pem"
    file.write_bytes(secret + made.public_bytes(pem))
    return file


def test_server_needs_a_valid_certificate(certificate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with receiver(lambda n: 200, certificate=certificate) as found:
        named = found.url.replace("127.0.0.1", "localhost")
        with pytest.raises(ssl.SSLCertVerificationError):
            safe_http.post(named, b"x", {}, private=True)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        assert safe_http.post(named, b"x", {}, private=True) == 200
        with pytest.raises(ssl.SSLCertVerificationError):  # the certificate is for another name
            safe_http.post(found.url, b"x", {}, private=True)
    assert len(found.received) == 1


@given(st.one_of(st.text(), st.text().map("https://{}/".format), st.text().map("https://[{}]:1/".format)))
def test_any_text_is_accepted_or_refused(url: str) -> None:
    with suppress(OptionError):
        safe_http.check_url(url, private=False)


@contextmanager
def answering(send: Callable[[socket.socket], None]) -> Iterator[str]:
    """A server that reads a request and answers with any bytes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection, suppress(OSError):
                connection.recv(65536)
                send(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/"
        thread.join()


def test_server_that_sends_single_bytes_times_out() -> None:
    def drip(connection: socket.socket) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\n")
        while True:
            connection.sendall(b"X")
            threading.Event().wait(0.0002)

    for _ in range(20):  # what arrives after the end may reset the connection
        with answering(drip) as url, pytest.raises(TimeoutError, match=r"0\.05 s"):
            safe_http.post(url, b"x", {}, private=True, seconds=0.05)


@pytest.mark.parametrize("line", [b"x" * 100_000 + b"\r\n", b"X: y\r\n" * 10_000], ids=["long", "many"])
def test_endless_head_is_not_read(line: bytes) -> None:
    def flood(connection: socket.socket) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\n")
        while True:
            connection.sendall(line)

    with answering(flood) as url, pytest.raises((OSError, safe_http.http.client.HTTPException)):
        safe_http.post(url, b"x", {}, private=True)


def test_endless_body_is_not_read() -> None:
    def flood(connection: socket.socket) -> None:
        connection.sendall(b"HTTP/1.1 204 No Content\r\nTransfer-Encoding: chunked\r\n\r\n")
        while True:
            connection.sendall(b"ffff\r\n" + bytes(0xFFFF) + b"\r\n")

    with answering(flood) as url:
        assert safe_http.post(url, b"x", {}, private=True) == 204
