"""What was read of mattes, kept in memory within bounds: a matte is composited thousands of times."""

import threading
from collections import OrderedDict
from concurrent.futures import Future

from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.composite.depth import Places, places_of
from workflows.composite.strips import Blocks, Strip, columns_of, read_strip

Key = tuple[str, int, int, tuple[int, ...]]
OPEN = 256
"""Mattes whose attributes are kept, some kilobytes each."""


class Cache:
    """Strips of mattes, those that were asked for last; for any number of threads.

    Parameters
    ----------
    objects : Objects
        Where mattes are.
    memory : int
        Bytes of strips that are kept, and an eighth of it for `places`. What is in use besides is a strip a thread.
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
        """Of the strips that are kept."""
        self.hits = self.misses = 0
        """Strips that were asked for and there; and those that were read."""

    def matte(self, id: str) -> Matte:
        """A matte, opened once.

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
        """A strip of a matte, as `read_strip` reads it, once however many ask for it at a time.

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
                self.hits += 1
                return strip
            read = self._reading.get(key)
            if read is None:
                mine = self._reading[key] = Future()
                self.misses += 1
        if read is not None:
            return read.result()
        try:
            strip = read_strip(matte, row, number, there)
        except BaseException as error:
            with self._lock:
                if self._reading.get(key) is mine:  # else the matte was deleted meanwhile, which is often why
                    del self._reading[key]
            mine.set_exception(error)
            raise
        with self._lock:
            # Unless the matte was deleted meanwhile.
            if self._reading.pop(key, None) is mine:
                self._strips[key] = strip
                self.bytes += strip.nbytes
                while self.bytes > self._memory:
                    _, old = self._strips.popitem(last=False)
                    self.bytes -= old.nbytes
        mine.set_result(strip)
        return strip

    def places(self, id: str, threads: int) -> Places:
        """Where the pixels of a matte look, as `places_of` tells; of a few mattes it is kept."""
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
        """Keep nothing of a matte that is no more."""
        with self._lock:
            self._mattes.pop(id, None)
            self._places.pop(id, None)
            for key in [key for key in self._strips if key[0] == id]:
                self.bytes -= self._strips.pop(key).nbytes
            for key in [key for key in self._reading if key[0] == id]:
                del self._reading[key]
