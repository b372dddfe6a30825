"""A look at everything that is stored: what is missing, damaged, or there without anyone knowing of it.

It may run beside a service. What is deleted meanwhile is no finding, for whatever is found is looked at twice, and what
is being written is left out.
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

AGAIN = 1.0
"""Seconds between the first and the second look at what was found: of two objects that belong together, one may have
been written when the other was not yet."""


@dataclass(frozen=True)
class Report:
    """What was found.

    Attributes
    ----------
    things : int
        Captures, mattes, uploads and composites that were read.
    busy : int
        Those that were not, because they are being written.
    read : dict of str to int
        As of `Examiner`.
    findings : list of Finding
    """

    things: int
    busy: int
    read: dict[str, int]
    findings: list[Finding]


def verify(
    engine: Engine, objects: Objects, progress: Callable[[float, int], None] = lambda share, size: None
) -> Report:
    """Read all that is stored.

    Parameters
    ----------
    progress : callable
        Gets the share of the things that were read, and their bytes.
    """
    things = _things(engine)
    found: dict[Item, list[Finding]] = {}
    whole = [thing for thing in things if thing.state != "busy"]
    with Examiner(objects) as examiner:
        for n, thing in enumerate(whole):
            if findings := examiner.examine(thing):
                found[thing] = findings
            progress((n + 1) / len(whole), examiner.read["bytes"])
        read = dict(examiner.read)
        findings = _unexpected(objects, things)
        if found:
            time.sleep(AGAIN)
            now = set(_things(engine))
            for thing, before in found.items():
                if thing in now:
                    again = examiner.examine(thing)
                    findings += [one for one in before if one in again]
    counts = {name: read.get(name, 0) for name in ("objects", "bytes", "unchecked", "unchecked_bytes")}
    return Report(len(whole), len(things) - len(whole), counts, findings)


def _things(engine: Engine) -> list[Item]:
    with reading(engine) as c:
        return list(inventory.items(c, row_dump.tables_of(c)))


def _unexpected(objects: Objects, things: list[Item]) -> list[Finding]:
    """What no row stands for, and nobody wrote to for a while: a row may be about to come."""
    known = {thing.folder for thing in things}
    remedy = "no row stands for it: a service that runs removes it within an hour"
    return [
        Finding("unexpected", f"{folder}/{name}", remedy)
        for folder in FOLDERS
        for name in objects.stale_names(
            folder, GRACE_SECONDS, but={"zarr.json", *(path.removeprefix(f"{folder}/") for path in known)}
        )
    ]
