"""A cache in memory of what was read of mattes, because a matte is composited thousands of times."""

import threading
from collections import OrderedDict
from concurrent.futures import Future

from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.composite.strips import Blocks, Strip, columns_of, read_strip
from workflows.mattes.perspective import Places, places_of

Key = tuple[str, int, int, tuple[int, ...]]
OPEN = 256
"""Mattes whose attributes are kept, at some kilobytes each."""


class Cache:
    """Keeps the most recently used strips of mattes. It is thread-safe.

    Parameters
    ----------
    objects : Objects
        Where mattes are stored.
    memory : int
        Bytes of strips to keep; `places` may take an eighth of it in addition. Each thread uses one strip more.
    """

    def __init__(self, objects: Objects, memory: int) -> None:
        self._objects = objects
        self._memory = memory
        self._lock = threading.Lock()
        self._mattes: OrderedDict[str, Matte] = OrderedDict()
        self._strips: OrderedDict[Key, Strip] = OrderedDict()
        self._places: OrderedDict[str, Places] = OrderedDict()
        self._reading: dict[Key, Future[Strip]] = {}
        self.bytes = 0
        """Size of the strips that are kept."""

    def matte(self, id: str) -> Matte:
        """Open a matte, or return it if it is open already.

        Raises
        ------
        Corrupt
            If it is not in the store.
        """
        with self._lock:
            found = self._mattes.get(id)
            if found is not None:
                self._mattes.move_to_end(id)
                return found
        found = Matte(self._objects, id)
        with self._lock:
            self._mattes[id] = found
            if len(self._mattes) > OPEN:
                self._mattes.popitem(last=False)
        return found

    def strip(self, id: str, row: int, number: int, there: Blocks | None = None) -> Strip:
        """A strip of a matte, see `read_strip`. Threads that ask for it at the same time share one read.

        Raises
        ------
        Corrupt
            If some of it is missing.
        """
        matte = self.matte(id)
        columns = columns_of(matte, number)
        key = (id, row, number, tuple(c for c in columns if there is None or (row, c) in there))
        with self._lock:
            strip = self._strips.get(key)
            if strip is not None:
                self._strips.move_to_end(key)
                return strip
            read = self._reading.get(key)
            if read is None:
                mine = self._reading[key] = Future()
        if read is not None:
            return read.result()
        try:
            strip = read_strip(matte, row, number, there)
        except BaseException as error:
            with self._lock:
                self._end(key, mine)
            mine.set_exception(error)
            raise
        with self._lock:
            if self._end(key, mine):
                self._strips[key] = strip
                self.bytes += strip.nbytes
                while self.bytes > self._memory:
                    _, old = self._strips.popitem(last=False)
                    self.bytes -= old.nbytes
        mine.set_result(strip)
        return strip

    def _end(self, key: Key, read: Future[Strip]) -> bool:
        """End a read; False if the matte was forgotten meanwhile. Another thread may read it again then."""
        is_wanted = self._reading.get(key) is read
        if is_wanted:
            del self._reading[key]
        return is_wanted

    def places(self, id: str, threads: int) -> Places:
        """Where the pixels of a matte look, see `places_of`; kept for a few mattes."""
        with self._lock:
            found = self._places.get(id)
        if found is None:
            found = places_of(self.matte(id), threads)
            with self._lock:
                self._places[id] = found
                while sum(places.nbytes for places in self._places.values()) > self._memory // 8:
                    self._places.popitem(last=False)
        return found

    def forget(self, id: str) -> None:
        """Drop everything of a matte that was deleted."""
        with self._lock:
            self._mattes.pop(id, None)
            self._places.pop(id, None)
            for key in [key for key in self._strips if key[0] == id]:
                self.bytes -= self._strips.pop(key).nbytes
            for key in [key for key in self._reading if key[0] == id]:
                del self._reading[key]
