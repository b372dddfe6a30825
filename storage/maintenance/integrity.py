"""Whether what is stored is what was written: every object of a thing is read, and held against its checksum.

What a thing must have is told by its kind, and by the ``zarr.json`` of its arrays: every chunk of every array.
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
from storage.layout.matte_archive import GROUPS, rows_folder
from storage.maintenance.inventory import Item
from storage.objects.checksums import BLOCK, SUFFIX, damaged, is_checked, is_intact, remedy, unseal
from storage.objects.store import Objects

THREADS = 8
"""Objects that are read at once: a bucket takes tens of milliseconds to answer."""
Take = Callable[[str, Iterator[bytes]], None]
"""What is done with an object's bytes, in pieces, as they are read; it must read them all."""


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes
    ----------
    what : str
    object : str
        Its path in the store.
    remedy : str
    """

    what: Literal["missing", "damaged", "unexpected"]
    object: str
    remedy: str


def discard(path: str, pieces: Iterable[bytes]) -> None:
    """Read an object, and that is all."""
    for _ in pieces:
        pass


class Examiner:
    """Reads things, object by object, several at once.

    Parameters
    ----------
    objects : Objects
    take : callable
        Gets the bytes of every object that a thing has to have, by its path, in one of several threads.

    Attributes
    ----------
    read : collections.Counter
        ``objects`` and ``bytes`` that were read; ``unchecked`` and ``unchecked_bytes``, of those the ones that have no
        checksum, for they were stored before there were checksums.
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

    def examine(self, thing: Item) -> list[Finding]:
        """Read a thing, and return what is not as it should be: memory is that of a few chunks, whatever its size."""
        sizes = self._objects.sizes(thing.folder)
        look = self._look_at_arrays if thing.kind in ("capture", "matte") else self._look_at_files
        found = list(look(thing, sizes))
        # What is being written may still lack anything, or have more than its rows tell.
        return [one for one in found if thing.state == "whole" or one.what == "damaged"]

    def _look_at_files(self, thing: Item, sizes: dict[str, int]) -> Iterator[Finding]:
        expected = []
        if thing.kind == "upload":
            expected = [uploads.part_path(thing.id, name) for name in thing.parts]
        elif thing.kind == "archive":
            index = f"{thing.folder}/{uploads.INDEX}"
            try:
                expected = [index, *_parts_of(self._objects, thing.id)]
            except FileNotFoundError:
                yield missing(index)
            except Corrupt as error:
                yield _damaged(str(error.fields.get("entry", index)))
        elif thing.state == "whole":
            expected = [composites.video_path(thing.id)]
        else:
            expected = sorted(path for path in sizes if not path.endswith(SUFFIX))
        yield from self._all(self._look_at_file, [(path,) for path in expected])

    def _look_at_file(self, path: str) -> Finding | None:
        with self._objects.reader(path) as file:
            self._take(path, iter(lambda: file.read(BLOCK), b""))
            self._count(file.size, file.is_checked)
            if file.is_checked:
                table = self._objects.read_raw(path + SUFFIX)
                self._take(path + SUFFIX, iter([table]))
                self._count(len(table), True)
        return None

    def _look_at_arrays(self, thing: Item, sizes: dict[str, int]) -> Iterator[Finding]:
        documents: dict[str, dict[str, Any]] = {}
        paths = sorted(path for path in sizes if path.endswith("/zarr.json"))
        yield from self._all(self._look_at_document, [(path, documents) for path in paths])
        there = {path.removesuffix("/zarr.json") for path in paths}
        for folder in sorted(_expected(thing, documents, sizes) - there):
            yield missing(f"{folder}/zarr.json")
        chunks = []
        for folder, document in documents.items():
            for path in _chunks(folder, document):
                if path in sizes:
                    chunks.append((path, is_checked(document)))
                else:
                    yield missing(path)
        yield from self._all(self._look_at_chunk, chunks)
        known = {path for path, _ in chunks} | set(paths)
        for path in sorted(sizes.keys() - known):
            # Of an array that is not known no chunk is: that was said of its zarr.json.
            if path.rpartition("/c/")[0] in documents or "/c/" not in path.removeprefix(thing.folder):
                yield Finding("unexpected", path, "nothing reads it: remove it from the store")

    def _look_at_document(self, path: str, documents: dict[str, dict[str, Any]]) -> Finding | None:
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

    def _look_at_chunk(self, path: str, checked: bool) -> Finding | None:
        data = self._objects.read_raw(path)
        if checked and not is_intact(data):
            raise damaged(path)
        self._take(path, iter([data]))
        self._count(len(data), checked)
        return None

    def _all(
        self, look: Callable[..., Finding | None], these: Sequence[tuple[Any, ...]]
    ) -> Iterator[Finding]:
        """Look at objects, several at once, and a bounded number under way."""

        def told(arguments: tuple[Any, ...]) -> Finding | None:
            try:
                return look(*arguments)
            except FileNotFoundError:
                return missing(arguments[0])
            except Corrupt as error:
                return _damaged(str(error.fields.get("entry", arguments[0])))

        for first in range(0, len(these), 4 * THREADS):
            yield from filter(None, self._pool.map(told, these[first : first + 4 * THREADS]))

    def _count(self, size: int, checked: bool) -> None:
        more = {"objects": 1, "bytes": size}
        with self._lock:
            self.read.update(more if checked else more | {"unchecked": 1, "unchecked_bytes": size})


def missing(path: str) -> Finding:
    """What is found of an object that is not there."""
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


def _expected(thing: Item, documents: dict[str, dict[str, Any]], sizes: Iterable[str]) -> set[str]:
    """The folders that must have a zarr.json: those of the thing's kind, and those in which something lies."""
    names: list[str] = ["", "frames", MEASURED]
    if thing.kind == "matte":
        names = [name.removesuffix("zarr.json").rstrip("/") for name in GROUPS]
        figures = documents.get(thing.folder, {}).get("attributes", {})
        height, width, edge = (figures.get(name) for name in ("height", "width", "block"))
        if all(isinstance(one, int) and one > 0 for one in (height, width, edge)):
            for row, column in product(range(-(-height // edge)), range(-(-width // edge))):
                T = rows_folder(row, column)
                names += [T, f"{T}/cell", f"{T}/weight"]
    expected = {f"{thing.folder}/{name}".rstrip("/") for name in names}
    for path in sizes:
        at = path.rpartition("/c/" if "/c/" in path.removeprefix(thing.folder) else "/")[0]
        while len(at) >= len(thing.folder):
            expected.add(at)
            at = at.rpartition("/")[0]
    return expected


def _chunks(folder: str, document: dict[str, Any]) -> Iterator[str]:
    """The paths of an array's chunks; of a group there are none."""
    if document["node_type"] == "group":
        return iter(())
    edges = document["chunk_grid"]["configuration"]["chunk_shape"]
    grid = [range(-(-n // edge)) for n, edge in zip(document["shape"], edges, strict=True)]
    return (f"{folder}/c/{'/'.join(map(str, at))}" for at in product(*grid))
