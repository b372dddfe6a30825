"""Restoring a backup into an empty installation: all of it, or nothing.

Every byte is compared with the manifest while it is copied. Objects come first; the rows follow in one transaction.
Until then, a marker in the store says that its objects belong to an unfinished restore, and the next restore removes
them.
"""

import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import IO, Any, NamedTuple

from sqlalchemy import Connection, Engine, MetaData, select

from storage.database import dialects, migrations
from storage.database.dialects import clock
from storage.database.engine import reading, writing
from storage.database.tables import metadata
from storage.errors import Conflict, Corrupt, InvalidInput, NoRoom
from storage.maintenance import row_dump
from storage.maintenance.backup import FORMAT, LEDGER, MANIFEST, OBJECTS, Tally
from storage.maintenance.integrity import THREADS
from storage.maintenance.inventory import FOLDERS
from storage.objects.byte_objects import PART
from storage.objects.store import Objects

MARKER = "restoring"
"""Object in the store during a restore: names the database that the rows will go to."""
LINE = 1 << 16
"""Most bytes of a line of the manifest."""
NAME = re.compile(rf"({'|'.join(FOLDERS)})(/[A-Za-z0-9_-][A-Za-z0-9._-]*)+")
"""Valid names of objects: none leaves its folder."""
SHA256 = re.compile("[0-9a-f]{64}")


def restore(
    source: Objects,
    engine: Engine,
    objects: Objects,
    progress: Callable[[float, int], None] = lambda share, size: None,
) -> dict[str, int]:
    """Restore a backup.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        Of a database without rows; it may have no tables.
    objects : Objects
        An empty store.
    progress : callable
        Called with the share of the bytes that were restored, and their number.

    Returns
    -------
    dict of str to int
        Counts of ``objects``, ``bytes`` and ``rows`` restored.

    Raises
    ------
    Conflict
        If there is no backup, a newer envmatte made it, the installation is not empty, or a service runs on it.
    InvalidInput
        If the backup does not match its manifest.
    NoRoom
        If the store has too little space.
    """
    manifest = Manifest(source)
    with reading(engine) as c:
        _require_empty_database(c)
    database = dialects.display_url(engine.url).encode()
    _require_empty_store(objects, database)
    free = objects.free_bytes()
    if free is not None and free < manifest.bytes:
        raise NoRoom(
            f"the backup has {manifest.bytes} bytes, but the disk of the store only {free} free; free space on it"
        )
    objects.put(MARKER, database)
    try:
        _copy(source, objects, manifest, progress)
        with tempfile.TemporaryFile() as rows:
            rows.writelines(_read(source, LEDGER, manifest.ledger))
            rows.seek(0)
            with writing(engine) as c:
                _require_empty_database(c)
                count = _insert_rows(c, manifest.revision, rows)
    except BaseException:
        with reading(engine) as c:
            counts = row_dump.counts(c, row_dump.tables_of(c))
        if not counts:  # otherwise the transaction was committed, and only its confirmation was lost
            _clear(objects)
        raise
    objects.delete(MARKER)
    return {"objects": manifest.objects, "bytes": manifest.bytes, "rows": count}


class Entry(NamedTuple):
    """An object of the backup, or its ledger, as the manifest describes it.

    Attributes
    ----------
    name : str
        Of the object in the store.
    size : int
        In bytes.
    sha256 : str
        In hexadecimal digits.
    """

    name: str
    size: int
    sha256: str


class Manifest:
    """The manifest of a backup; iterating over it yields the entry of each object.

    Attributes
    ----------
    revision : str
    ledger : Entry
    objects, bytes : int

    Raises
    ------
    Conflict
        If there is none, or a newer envmatte wrote it.
    InvalidInput
        If it is incomplete or invalid.
    """

    def __init__(self, source: Objects) -> None:
        self._source = source
        try:
            lines = self._lines()
            header = _object(next(lines, b""))
            if header.get("format") != FORMAT:
                raise Conflict(
                    f"the backup has the format {header.get('format')!r}, but this envmatte reads {FORMAT!r}; "
                    "install the envmatte that made it"
                )
            self.revision = str(header.get("revision"))
            self.ledger = _ledger_entry(header.get("ledger"))
            migrations.require_known(self.revision, "the backup")
            self._check_complete()
        except FileNotFoundError as error:
            raise Conflict(
                f"{source.url} has no {MANIFEST}: there is no backup, or it was never finished"
            ) from error

    def _lines(self) -> Iterator[bytes]:
        with self._source.read(MANIFEST) as file:
            while line := file.readline(LINE):
                yield line

    def _check_complete(self) -> None:
        digest, before = hashlib.sha256(), b""
        self.objects, self.bytes = -1, 0
        for line in self._lines():
            if before:
                digest.update(before)
                if self.objects >= 0:
                    self.bytes += _object_entry(_object(before)).size
                self.objects += 1
            before = line
        last = {"objects": self.objects, "bytes": self.bytes, "sha256": digest.hexdigest()}
        if _object(before) != last:
            raise _incomplete()

    def __iter__(self) -> Iterator[Entry]:
        for line in islice(self._lines(), 1, self.objects + 1):
            yield _object_entry(_object(line))


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise _incomplete()
    return found


def _incomplete() -> InvalidInput:
    return InvalidInput(f"{MANIFEST} of the backup is incomplete or was changed; use another backup")


def _object_entry(given: dict[str, Any]) -> Entry:
    name = given.get("name")
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise InvalidInput(f"{MANIFEST} of the backup has the invalid object name {name!r}")
    return _entry(name, given)


def _ledger_entry(given: Any) -> Entry:
    return _entry(LEDGER, given if isinstance(given, dict) else {})


def _entry(name: str, given: dict[str, Any]) -> Entry:
    size, digest = given.get("size"), given.get("sha256")
    if not (isinstance(size, int) and size >= 0 and isinstance(digest, str) and SHA256.fullmatch(digest)):
        raise InvalidInput(f"{MANIFEST} of the backup has no valid size and checksum for {name}")
    return Entry(name, size, digest)


def _copy(
    source: Objects, objects: Objects, manifest: Manifest, progress: Callable[[float, int], None]
) -> None:
    def one(entry: Entry) -> int:
        objects.write_raw(entry.name, _read(source, f"{OBJECTS}/{entry.name}", entry))
        return entry.size

    done, entries = 0, iter(manifest)
    with ThreadPoolExecutor(THREADS, thread_name_prefix="restoring") as pool:
        while some := list(islice(entries, 4 * THREADS)):
            for size in pool.map(one, some):
                done += size
            progress(done / max(manifest.bytes, 1), done)


def _read(source: Objects, path: str, entry: Entry) -> Iterator[bytes]:
    """The pieces of an object of the backup, see `_checked`."""
    try:
        if entry.size <= PART:  # true of most objects, which take one request then
            yield from _checked(entry, iter([source.read_raw(path, entry.size)]))
        else:
            with source.reader(path) as reader:
                yield from _checked(entry, iter(lambda: reader.read(PART), b""))
    except FileNotFoundError as error:
        raise InvalidInput(
            f"{entry.name} is missing in the backup; use another backup", entry=entry.name
        ) from error
    except Corrupt as error:
        raise _mismatch(entry.name) from error


def _checked(entry: Entry, pieces: Iterator[bytes]) -> Iterator[bytes]:
    """The pieces of an object; raises after the last if they do not match the manifest."""
    tally = Tally()
    for piece in tally.passing(pieces):
        if tally.size > entry.size:
            raise _mismatch(entry.name)
        yield piece
    if (tally.size, tally.sha256) != (entry.size, entry.sha256):
        raise _mismatch(entry.name)


def _mismatch(name: str) -> InvalidInput:
    return InvalidInput(
        f"{name} in the backup does not match {MANIFEST}: it is damaged; use another backup", entry=name
    )


def _require_empty_database(connection: Connection) -> None:
    tables = row_dump.tables_of(connection)
    found = row_dump.counts(connection, tables)
    if found:
        rows = ", ".join(f"{count} of {name}" for name, count in found.items())
        raise Conflict(
            f"the installation is not empty: its database has rows ({rows}). Restore into an empty installation: name "
            "another folder, or another database and store"
        )
    if "coordinator" in tables and "holder" in tables["coordinator"].c:
        lease = tables["coordinator"].c
        if connection.scalar(select(lease.holder).where(lease.expires_at > clock())):
            raise Conflict("a service runs on the installation; stop it until the backup is restored")


def _require_empty_store(objects: Objects, database: bytes) -> None:
    """Check that the store is empty, after removing the leftovers of an interrupted restore.

    Leftovers are removed only if that restore was into the same database, which is empty; with another database, the
    objects may be in use.
    """
    if MARKER in objects.names("") and objects.read_raw(MARKER) == database:
        _clear(objects)
    for folder in FOLDERS:
        there = [name for name in objects.names(folder) if name != "zarr.json"]
        if there:
            raise Conflict(
                f"the installation is not empty: its store {objects.url} has {folder}/{there[0]}. Restore into "
                "an empty installation: name another folder, or another prefix of the bucket"
            )


def _clear(objects: Objects) -> None:
    for what in (*FOLDERS, MARKER):
        objects.delete(what)


def _insert_rows(connection: Connection, revision: str, rows: IO[bytes]) -> int:
    """Create the tables at the revision of the backup, insert the rows, and upgrade the schema."""
    there = MetaData()
    there.reflect(connection, only=lambda name, _: name in metadata.tables or name == "alembic_version")
    there.drop_all(connection)
    migrations.upgrade(connection, revision)
    count = row_dump.insert_lines(connection, rows)
    migrations.upgrade(connection)
    row_dump.continue_numbering(connection)
    return count
