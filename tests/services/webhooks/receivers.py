"""Receivers of webhooks: small web servers that record what they get."""

import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


@dataclass
class Receiver:
    """The URL of a receiver, and the headers and bodies of the requests that it got."""

    url: str = ""
    received: list[tuple[dict[str, str], bytes]] = field(default_factory=list)
    news: threading.Event = field(default_factory=threading.Event)


@contextmanager
def receiver(
    status: Callable[[int], int], certificate: Path | None = None, host: str = "127.0.0.1", **headers: str
) -> Iterator[Receiver]:
    """A receiver on a free port of loopback that answers request n with ``status(n)``; with a certificate, over TLS."""
    found = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            answer = status(len(found.received))
            found.received.append((dict(self.headers), body))
            found.news.set()
            self.send_response(answer)
            for name, value in ({"Content-Length": "0"} | headers).items():
                self.send_header(name, value)
            self.end_headers()

        def log_message(self, *arguments: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

    with Server((host, 0), Handler) as server:
        scheme = "http"
        if certificate:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(certificate)
            server.socket = context.wrap_socket(server.socket, server_side=True)
            scheme = "https"
        found.url = (
            f"{scheme}://{f'[{host}]' if ':' in host else host}:{server.server_port}/webhook?by=envmatte"
        )
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield found
        finally:
            server.shutdown()
            thread.join()
