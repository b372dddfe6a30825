"""A backup of a whole installation: every row and every object, in a folder or a bucket of its own.

- ``ledger.jsonl``: the rows, see `storage.maintenance.row_dump`; all as one transaction saw them, at the start.
- ``objects/…``: what those rows stand for in the store, under the same names and as the same bytes.
- ``manifest.jsonl``, written last, for without it there is no backup: a line with the ``format``, ``version``,
  ``revision`` of the schema, ``made_at`` and the ``size`` and ``sha256`` of the ``ledger``; a line for each object with
  its ``name``, ``size`` and ``sha256``; and a line with the number of ``objects``, their ``bytes``, and the ``sha256``
  of all lines before.

It is taken while services run. What is deleted meanwhile is left out with its rows; of what is turned into something
else, an archive into a capture say, the rows are taken anew.
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
    """The ``size`` in bytes, and the SHA-256, of pieces that have passed through it."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self.size = 0

    def passing(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        """The pieces, each counted before it is given."""
        for piece in pieces:
            self._digest.update(piece)
            self.size += len(piece)
            yield piece

    @property
    def sha256(self) -> str:
        """In hexadecimal digits."""
        return self._digest.hexdigest()


def back_up(
    engine: Engine,
    objects: Objects,
    target: Objects,
    version: str,
    progress: Callable[[float, int], None] = lambda share, size: None,
) -> dict[str, int]:
    """Make a backup; memory is that of some chunks and the ids of what there is, whatever its size.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        Of the database, which may be of an earlier revision.
    version : str
        Of envmatte.
    progress : callable
        Gets the share of the things that were copied, and their bytes.

    Returns
    -------
    dict of str to int
        ``objects``, ``bytes`` and ``rows`` that it has.

    Raises
    ------
    Conflict
        If there is something at the target.
    Corrupt
        If something that is to be copied is missing or damaged. Nothing is left at the target then.
    """
    _see_that_it_is_empty(target)
    try:
        with tempfile.TemporaryFile() as rows, tempfile.TemporaryFile() as entries:
            copying = _Copying(engine, objects, target, rows, entries)
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


def _see_that_it_is_empty(target: Objects) -> None:
    there = target.names("")
    if MANIFEST in there:
        raise Conflict(
            f"{target.url} has a backup already: name an empty folder, or another prefix of the bucket"
        )
    if there:
        raise Conflict(
            f"{target.url} is not empty, {there[0]!r} is there: name an empty folder, or another prefix of the bucket; "
            "what an interrupted backup has left there has no use, and can be removed"
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
    """A backup that is being made.

    Attributes
    ----------
    revision : str
        Of the schema.
    count : int
        Families at the start.
    objects, bytes, rows : int
        That were copied.
    """

    def __init__(
        self, engine: Engine, objects: Objects, target: Objects, rows: IO[bytes], entries: IO[bytes]
    ) -> None:
        self._engine, self._target = engine, target
        self._rows, self._entries = rows, entries
        self._of_family: list[dict[str, Any]] = []
        self._anew: dict[str, list[Line]] = {}
        self.revision = ""
        self.count = self.objects = self.bytes = self.rows = 0

    def snapshot(self) -> dict[str, list[Item]]:
        """Write down all rows, as they are at one time; returns what they stand for, by family."""
        families: dict[str, list[Item]] = {}
        with reading(self._engine) as c:
            self.revision = revision(c) or ""
            tables = row_dump.tables_of(c)
            for name, row in row_dump.lines(c, tables):
                self._rows.write(row_dump.to_line(name, row))
                for thing in inventory.items_of_row(c, tables, name, row):
                    families.setdefault(thing.family, []).append(thing)
        self.count = len(families)
        return families

    def take(self, path: str, pieces: Iterator[bytes]) -> None:
        """Copy an object; called by several threads."""
        tally = Tally()
        self._target.write_raw(f"{OBJECTS}/{path}", tally.passing(pieces))
        self._of_family.append({"name": path, "size": tally.size, "sha256": tally.sha256})

    def copy(self, examiner: Examiner, family: str, things: list[Item]) -> None:
        """Copy what belongs together, as often as it changes meanwhile.

        Raises
        ------
        Corrupt
            If something is missing or damaged, though its rows have not changed.
        """
        faults: set[Finding] = set()
        while True:
            found = [one for thing in things for one in examiner.examine(thing) if one.what != "unexpected"]
            if not found and all(thing.state == "whole" for thing in things):
                break
            lines, now = self._look_again(family)
            # What is being written, and still has its row, was not deleted before it was copied.
            if not found and {(one.kind, one.id) for one in things} <= {(one.kind, one.id) for one in now}:
                break
            if set(now) == set(things) and faults & set(found):
                first = next(one for one in found if one in faults)
                raise Corrupt(
                    f"{first.object} is {first.what} in the store, and a backup would be without it: {first.remedy}. "
                    "`envmatte verify` finds all there is of the kind",
                    entry=first.object,
                )
            for thing in things:
                self._target.delete(f"{OBJECTS}/{thing.folder}")
            self._of_family.clear()
            self._anew[family], things, faults = lines, now, set(found)
        for entry in sorted(self._of_family, key=lambda entry: str(entry["name"])):
            self._entries.write(json.dumps(entry).encode() + b"\n")
            self.objects += 1
            self.bytes += entry["size"]
        self._of_family.clear()

    def _look_again(self, family: str) -> tuple[list[Line], list[Item]]:
        """The rows of a family as they are now, and what they stand for."""
        with reading(self._engine) as c:
            tables = row_dump.tables_of(c)
            lines = list(row_dump.lines_of_family(c, tables, family))
            return lines, [thing for line in lines for thing in inventory.items_of_row(c, tables, *line)]

    def put_ledger(self) -> dict[str, Any]:
        """Write the rows of what was copied; returns what the manifest says of them."""
        tally = Tally()
        self._target.write_raw(LEDGER, tally.passing(self._lines()))
        return {"rows": self.rows, "size": tally.size, "sha256": tally.sha256}

    def _lines(self) -> Iterator[bytes]:
        """All rows, counted: those of families that changed as they were when those were copied."""
        replaced: set[str] = set()
        self._rows.seek(0)
        for line in self._rows:
            if self._anew:
                name, row = json.loads(line)
                if inventory.family_of(name, row) in self._anew:
                    if name == "jobs":
                        replaced.add(row["id"])
                    continue
                if name in ("tiles", "log") and row["job"] in replaced:
                    continue
            self.rows += 1
            yield line
        for lines in self._anew.values():
            for name, row in lines:
                self.rows += 1
                yield row_dump.to_line(name, row)
