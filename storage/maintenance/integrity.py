"""Integrity check of items in the store: every object of an item is read and compared with its checksum.

The kind of an item and the ``zarr.json`` of its arrays say which objects it must have: every chunk of every array.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from threading import Lock
from typing import Any, Literal

from storage.errors import Corrupt
from storage.layout import composites, uploads
from storage.layout.captures import MEASURED
from storage.layout.matte_archive import GROUPS
from storage.layout.mattes import rows_folder
from storage.maintenance.inventory import Item
from storage.objects.checksums import BLOCK, SUFFIX, damaged, is_checked, is_intact, remedy, unseal
from storage.objects.store import Objects

THREADS = 8
"""Objects that are read at the same time: a bucket takes tens of milliseconds to respond."""
Take = Callable[[str, Iterator[bytes]], None]
"""Takes the path of an object and its bytes in pieces; it must read all of them."""


@dataclass(frozen=True)
class Finding:
    """Something wrong with an object in the store.

    Attributes
    ----------
    what : str
    object : str
        Its path in the store.
    remedy : str
        What to do about it.
    """

    what: Literal["missing", "damaged", "unexpected"]
    object: str
    remedy: str


def discard(path: str, pieces: Iterable[bytes]) -> None:
    """Read the bytes of an object and do nothing with them."""
    for _ in pieces:
        pass


class Examiner:
    """Checks items object by object, several objects at a time.

    Parameters
    ----------
    objects : Objects
    take : callable
        Called with the path and the bytes of every object that an item must have, in one of several threads.

    Attributes
    ----------
    read : collections.Counter
        ``objects`` and ``bytes`` that were read; of these, ``unchecked`` and ``unchecked_bytes`` have no checksum,
        because they were stored before there were checksums.
    """

    def __init__(self, objects: Objects, take: Take = discard) -> None:
        self._objects = objects
        self._take = take
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="examiner")
        self._lock = Lock()
        self.read: Counter[str] = Counter()

    def __enter__(self) -> "Examiner":
        return self

    def __exit__(self, *exception: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def examine(self, item: Item) -> list[Finding]:
        """Check an item and return what is wrong with it; takes the memory of a few chunks, whatever its size."""
        sizes = self._objects.sizes(item.folder)
        check = self._check_arrays if item.kind in ("capture", "matte") else self._check_files
        found = list(check(item, sizes))
        # An item that is being written may lack objects, or have more than its rows say.
        return [one for one in found if item.state == "whole" or one.what == "damaged"]

    def _check_files(self, item: Item, sizes: dict[str, int]) -> Iterator[Finding]:
        expected = []
        if item.kind == "upload":
            expected = [uploads.part_path(item.id, name) for name in item.parts]
        elif item.kind == "archive":
            index = f"{item.folder}/{uploads.INDEX}"
            try:
                expected = [index, *_parts_of(self._objects, item.id)]
            except FileNotFoundError:
                yield missing(index)
            except Corrupt as error:
                yield _damaged(str(error.fields.get("entry", index)))
        elif item.state == "whole":
            expected = [composites.video_path(item.id)]
        else:
            expected = sorted(path for path in sizes if not path.endswith(SUFFIX))
        yield from self._all(self._check_file, [(path,) for path in expected])

    def _check_file(self, path: str) -> Finding | None:
        with self._objects.reader(path) as file:
            self._take(path, iter(lambda: file.read(BLOCK), b""))
            self._count(file.size, file.is_checked)
            if file.is_checked:
                table = self._objects.read_raw(path + SUFFIX)
                self._take(path + SUFFIX, iter([table]))
                self._count(len(table), True)
        return None

    def _check_arrays(self, item: Item, sizes: dict[str, int]) -> Iterator[Finding]:
        documents: dict[str, dict[str, Any]] = {}
        paths = sorted(path for path in sizes if path.endswith("/zarr.json"))
        yield from self._all(self._check_document, [(path, documents) for path in paths])
        there = {path.removesuffix("/zarr.json") for path in paths}
        for folder in sorted(_expected(item, documents, sizes) - there):
            yield missing(f"{folder}/zarr.json")
        chunks = []
        for folder, document in documents.items():
            for path in _chunks(folder, document):
                if path in sizes:
                    chunks.append((path, is_checked(document)))
                else:
                    yield missing(path)
        yield from self._all(self._check_chunk, chunks)
        known = {path for path, _ in chunks} | set(paths)
        for path in sorted(sizes.keys() - known):
            # Chunks of an array without zarr.json are not reported again: its zarr.json is.
            if path.rpartition("/c/")[0] in documents or "/c/" not in path.removeprefix(item.folder):
                yield Finding("unexpected", path, "it is never read; remove it from the store")

    def _check_document(self, path: str, documents: dict[str, dict[str, Any]]) -> Finding | None:
        data = self._objects.read_raw(path)
        document, checked = unseal(path, data)
        self._take(path, iter([data]))
        self._count(len(data), checked)
        try:
            _chunks("", document)
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            return _damaged(path)
        documents[path.removesuffix("/zarr.json")] = document
        return None

    def _check_chunk(self, path: str, checked: bool) -> Finding | None:
        data = self._objects.read_raw(path)
        if checked and not is_intact(data):
            raise damaged(path)
        self._take(path, iter([data]))
        self._count(len(data), checked)
        return None

    def _all(
        self, check: Callable[..., Finding | None], these: Sequence[tuple[Any, ...]]
    ) -> Iterator[Finding]:
        """Check objects concurrently, a bounded number at a time."""

        def check_one(arguments: tuple[Any, ...]) -> Finding | None:
            try:
                return check(*arguments)
            except FileNotFoundError:
                return missing(arguments[0])
            except Corrupt as error:
                return _damaged(str(error.fields.get("entry", arguments[0])))

        for first in range(0, len(these), 4 * THREADS):
            yield from filter(None, self._pool.map(check_one, these[first : first + 4 * THREADS]))

    def _count(self, size: int, checked: bool) -> None:
        more = {"objects": 1, "bytes": size}
        with self._lock:
            self.read.update(more if checked else more | {"unchecked": 1, "unchecked_bytes": size})


def missing(path: str) -> Finding:
    """The finding for an object that is not there."""
    return Finding("missing", path, remedy(path))


def _damaged(path: str) -> Finding:
    return Finding("damaged", path, remedy(path))


def _parts_of(objects: Objects, archive: str) -> list[str]:
    index = f"{uploads.path(archive)}/{uploads.INDEX}"
    with objects.read(index) as file:
        try:
            return [uploads.part_path(archive, name) for name, _ in json.load(file)]
        except (ValueError, TypeError) as error:
            raise damaged(index) from error


def _expected(item: Item, documents: dict[str, dict[str, Any]], sizes: Iterable[str]) -> set[str]:
    """The folders that must have a zarr.json: by the kind of the item, and because they contain objects."""
    names: list[str] = ["", "frames", MEASURED]
    if item.kind == "matte":
        names = [name.removesuffix("zarr.json").rstrip("/") for name in GROUPS]
        figures = documents.get(item.folder, {}).get("attributes", {})
        height, width, edge = (figures.get(name) for name in ("height", "width", "block"))
        if all(isinstance(one, int) and one > 0 for one in (height, width, edge)):
            for row, column in product(range(-(-height // edge)), range(-(-width // edge))):
                T = rows_folder(row, column)
                names += [T, f"{T}/cell", f"{T}/weight"]
    expected = {f"{item.folder}/{name}".rstrip("/") for name in names}
    for path in sizes:
        at = path.rpartition("/c/" if "/c/" in path.removeprefix(item.folder) else "/")[0]
        while len(at) >= len(item.folder):
            expected.add(at)
            at = at.rpartition("/")[0]
    return expected


def _chunks(folder: str, document: dict[str, Any]) -> Iterator[str]:
    """The paths of an array's chunks; a group has none."""
    if document["node_type"] == "group":
        return iter(())
    edges = document["chunk_grid"]["configuration"]["chunk_shape"]
    grid = [range(-(-n // edge)) for n, edge in zip(document["shape"], edges, strict=True)]
    return (f"{folder}/c/{'/'.join(map(str, at))}" for at in product(*grid))
