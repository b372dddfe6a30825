"""Verification of everything in the store: finds objects that are missing, damaged, or known to no row.

It may run while the service does. Items that are being written are skipped, and every finding is checked twice, so that
data deleted meanwhile is not reported.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import Engine

from storage.database.engine import reading
from storage.maintenance import inventory, row_dump
from storage.maintenance.integrity import Examiner, Finding
from storage.maintenance.inventory import FOLDERS, GRACE_SECONDS, Item
from storage.objects.store import Objects

RECHECK_AFTER = 1.0
"""Seconds until a finding is checked again: of two objects that belong together, one may have been written a moment
before the other."""


@dataclass(frozen=True)
class Report:
    """Result of a verification.

    Attributes
    ----------
    things : int
        Captures, mattes, uploads and composites that were checked.
    busy : int
        Those that were skipped because they are being written.
    read : dict of str to int
        Counts of `Examiner`.
    findings : list of Finding
    """

    things: int
    busy: int
    read: dict[str, int]
    findings: list[Finding]


def verify(
    engine: Engine, objects: Objects, progress: Callable[[float, int], None] = lambda share, size: None
) -> Report:
    """Check everything in the store.

    Parameters
    ----------
    progress : callable
        Called with the share of the items that were checked, and the bytes that were read.
    """
    items = _items(engine)
    found: dict[Item, list[Finding]] = {}
    whole = [item for item in items if item.state != "busy"]
    with Examiner(objects) as examiner:
        for n, item in enumerate(whole):
            if findings := examiner.examine(item):
                found[item] = findings
            progress((n + 1) / len(whole), examiner.read["bytes"])
        read = dict(examiner.read)
        findings = _unexpected(objects, items)
        if found:
            time.sleep(RECHECK_AFTER)
            now = set(_items(engine))
            for item, before in found.items():
                if item in now:
                    again = examiner.examine(item)
                    findings += [one for one in before if one in again]
    counts = {name: read.get(name, 0) for name in ("objects", "bytes", "unchecked", "unchecked_bytes")}
    return Report(len(whole), len(items) - len(whole), counts, findings)


def _items(engine: Engine) -> list[Item]:
    with reading(engine) as c:
        return list(inventory.items(c, row_dump.tables_of(c)))


def _unexpected(objects: Objects, items: list[Item]) -> list[Finding]:
    """Objects without a row that have not changed for a while; newer ones may be about to get a row."""
    known = {item.folder for item in items}
    before = objects.clock() - GRACE_SECONDS
    remedy = "no row refers to it; a running service removes it within an hour"
    return [
        Finding("unexpected", path, remedy)
        for path in (f"{folder}/{name}" for folder in FOLDERS for name in objects.names(folder))
        if path not in known and not path.endswith("/zarr.json") and objects.written_at(path) < before
    ]
