"""Backup of an installation: all rows and objects, in a folder or bucket of its own.

- ``ledger.jsonl``: the rows, see `storage.maintenance.row_dump`, as one transaction saw them at the beginning.
- ``objects/…``: the objects of those rows, with the same names and bytes as in the store.
- ``manifest.jsonl``, which is written last and makes the backup valid: a line with the ``format``, ``version``,
  ``revision`` of the schema, ``made_at``, and the ``size`` and ``sha256`` of the ``ledger``; a line for each object
  with its ``name``, ``size`` and ``sha256``; and a line with the number of ``objects``, their ``bytes``, and the
  ``sha256`` of all previous lines.

Services may run meanwhile. Data that is deleted during the backup is left out, with its rows. If an item changes into
another, such as an archive into a capture, its rows are read again.
"""

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from typing import IO, Any

from sqlalchemy import Engine

from storage.database.engine import reading
from storage.database.revision import revision
from storage.errors import Conflict, Corrupt
from storage.maintenance import inventory, row_dump
from storage.maintenance.integrity import Examiner, Finding
from storage.maintenance.inventory import Item
from storage.maintenance.row_dump import Line
from storage.objects.store import Objects

FORMAT = "envmatte-backup/1"
MANIFEST = "manifest.jsonl"
LEDGER = "ledger.jsonl"
OBJECTS = "objects"


class Tally:
    """Size in bytes and SHA-256 of the pieces that have passed through it."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self.size = 0

    def passing(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the pieces, and count each."""
        for piece in pieces:
            self._digest.update(piece)
            self.size += len(piece)
            yield piece

    @property
    def sha256(self) -> str:
        """The SHA-256 so far, in hexadecimal digits."""
        return self._digest.hexdigest()


def back_up(
    engine: Engine,
    objects: Objects,
    target: Objects,
    version: str,
    progress: Callable[[float, int], None] = lambda share, size: None,
) -> dict[str, int]:
    """Make a backup; takes the memory of a few chunks and of the ids of all items.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        Of the database, which may have an earlier revision.
    version : str
        Version of envmatte.
    progress : callable
        Called with the share of the items that were copied, and their bytes.

    Returns
    -------
    dict of str to int
        Counts of ``objects``, ``bytes`` and ``rows`` in the backup.

    Raises
    ------
    Conflict
        If the target is not empty.
    Corrupt
        If an object is missing or damaged; the target is empty then.
    """
    _require_empty(target)
    try:
        with tempfile.TemporaryFile() as rows, tempfile.TemporaryFile() as entries:
            copying = _Copying(engine, target, rows, entries)
            with Examiner(objects, copying.take) as examiner:
                families = copying.snapshot()
                while families:
                    copying.copy(examiner, *families.popitem())
                    progress(1 - len(families) / copying.count, copying.bytes)
            header: dict[str, Any] = {"format": FORMAT, "version": version, "revision": copying.revision}
            header |= {
                "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
                "ledger": copying.put_ledger(),
            }
            target.write_raw(MANIFEST, _manifest(header, entries))
            return {"objects": copying.objects, "bytes": copying.bytes, "rows": copying.rows}
    except BaseException:
        for what in (MANIFEST, LEDGER, OBJECTS):
            target.delete(what)
        raise


def _require_empty(target: Objects) -> None:
    there = target.names("")
    if MANIFEST in there:
        raise Conflict(
            f"{target.url} already has a backup; name an empty folder, or another prefix of the bucket"
        )
    if there:
        raise Conflict(
            f"{target.url} is not empty: it has {there[0]!r}. Name an empty folder, or another prefix of "
            "the bucket; leftovers of an interrupted backup are useless and can be removed"
        )


def _manifest(header: dict[str, Any], entries: IO[bytes]) -> Iterator[bytes]:
    digest, objects, size = hashlib.sha256(), 0, 0

    def line(of: dict[str, Any]) -> bytes:
        return json.dumps(of).encode() + b"\n"

    first = line(header)
    digest.update(first)
    yield first
    entries.seek(0)
    for entry in entries:
        digest.update(entry)
        objects, size = objects + 1, size + json.loads(entry)["size"]
        yield entry
    yield line({"objects": objects, "bytes": size, "sha256": digest.hexdigest()})


class _Copying:
    """The state of a backup while it is made.

    Attributes
    ----------
    revision : str
        Revision of the schema.
    count : int
        Number of families at the beginning.
    objects, bytes, rows : int
        Copied so far.
    """

    def __init__(self, engine: Engine, target: Objects, rows: IO[bytes], entries: IO[bytes]) -> None:
        self._engine, self._target = engine, target
        self._rows, self._entries = rows, entries
        self._of_family: list[dict[str, Any]] = []
        self._reread: dict[str, list[Line]] = {}
        self.revision = ""
        self.count = self.objects = self.bytes = self.rows = 0

    def snapshot(self) -> dict[str, list[Item]]:
        """Store all rows as one transaction sees them; returns their items, by family."""
        families: dict[str, list[Item]] = {}
        with reading(self._engine) as c:
            self.revision = revision(c) or ""
            tables = row_dump.tables_of(c)
            for name, row in row_dump.lines(c, tables):
                self._rows.write(row_dump.to_line(name, row))
                for item in inventory.items_of_row(c, tables, name, row):
                    families.setdefault(item.family, []).append(item)
        self.count = len(families)
        return families

    def take(self, path: str, pieces: Iterator[bytes]) -> None:
        """Copy an object; several threads call this."""
        tally = Tally()
        self._target.write_raw(f"{OBJECTS}/{path}", tally.passing(pieces))
        self._of_family.append({"name": path, "size": tally.size, "sha256": tally.sha256})

    def copy(self, examiner: Examiner, family: str, items: list[Item]) -> None:
        """Copy the items of a family, and again if they changed meanwhile.

        Raises
        ------
        Corrupt
            If an object is missing or damaged although the rows have not changed.
        """
        faults: set[Finding] = set()
        while True:
            found = [one for item in items for one in examiner.examine(item) if one.what != "unexpected"]
            if not found and all(item.state == "whole" for item in items):
                break
            lines, now = self._read_again(family)
            # Items that are still being written and still have their row were not deleted before they were copied.
            if not found and {(one.kind, one.id) for one in items} <= {(one.kind, one.id) for one in now}:
                break
            if set(now) == set(items) and faults & set(found):
                first = next(one for one in found if one in faults)
                raise Corrupt(
                    f"{first.object} is {first.what} in the store, so it cannot be backed up: {first.remedy}. "
                    "`envmatte verify` lists all such objects",
                    entry=first.object,
                )
            for item in items:
                self._target.delete(f"{OBJECTS}/{item.folder}")
            self._of_family.clear()
            self._reread[family], items, faults = lines, now, set(found)
        for entry in sorted(self._of_family, key=lambda entry: str(entry["name"])):
            self._entries.write(json.dumps(entry).encode() + b"\n")
            self.objects += 1
            self.bytes += entry["size"]
        self._of_family.clear()

    def _read_again(self, family: str) -> tuple[list[Line], list[Item]]:
        """The rows of a family as they are now, and their items."""
        with reading(self._engine) as c:
            tables = row_dump.tables_of(c)
            lines = list(row_dump.lines_of_family(c, tables, family))
            return lines, [item for line in lines for item in inventory.items_of_row(c, tables, *line)]

    def put_ledger(self) -> dict[str, Any]:
        """Write the ledger; returns its entry in the manifest."""
        tally = Tally()
        self._target.write_raw(LEDGER, tally.passing(self._lines()))
        return {"rows": self.rows, "size": tally.size, "sha256": tally.sha256}

    def _lines(self) -> Iterator[bytes]:
        """All rows, counted; those of families that changed are as they were when the family was copied."""
        replaced: set[str] = set()
        self._rows.seek(0)
        for line in self._rows:
            if self._reread:
                name, row = json.loads(line)
                if inventory.family_of(name, row) in self._reread:
                    if name in ("mattes", "jobs"):
                        replaced.add(row["id"])
                    continue
                if name in row_dump.OF_ROWS and row[row_dump.OF_ROWS[name]] in replaced:
                    continue
            self.rows += 1
            yield line
        for lines in self._reread.values():
            for name, row in lines:
                self.rows += 1
                yield row_dump.to_line(name, row)
