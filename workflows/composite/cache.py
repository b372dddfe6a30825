"""What was read of mattes, kept in memory within bounds: a matte is composited thousands of times."""

import threading
from collections import OrderedDict
from concurrent.futures import Future
from dataclasses import fields

from storage.mattes import Block, Matte
from storage.objects import Objects
from workflows.composite.rays import Places, places_of

Key = tuple[str, int, int]
OPEN = 256
"""Mattes whose attributes are kept, some kilobytes each."""


class Cache:
    """Blocks of mattes, those that were asked for last; for any number of threads.

    Parameters
    ----------
    objects : Objects
        Where mattes are.
    memory : int
        Bytes of blocks that are kept, and an eighth of it for `places`. What is in use besides is a block a thread.
    """

    def __init__(self, objects: Objects, memory: int) -> None:
        self._objects = objects
        self._memory = memory
        self._lock = threading.Lock()
        self._mattes: OrderedDict[str, Matte] = OrderedDict()
        self._blocks: OrderedDict[Key, Block] = OrderedDict()
        self._places: OrderedDict[str, Places] = OrderedDict()
        self._reading: dict[Key, Future[Block]] = {}
        self.bytes = 0
        """Of the blocks that are kept."""
        self.hits = self.misses = 0
        """Blocks that were asked for and there; and those that were read."""

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

    def block(self, id: str, row: int, column: int) -> Block:
        """A block of a matte, read once however many ask for it at a time.

        Raises
        ------
        Corrupt
            If some of it is missing.
        """
        key = (id, row, column)
        with self._lock:
            block = self._blocks.get(key)
            if block is not None:
                self._blocks.move_to_end(key)
                self.hits += 1
                return block
            read = self._reading.get(key)
            if read is None:
                mine = self._reading[key] = Future()
                self.misses += 1
        if read is not None:
            return read.result()
        try:
            block = self.matte(id).read(row, column)
        except BaseException as error:
            with self._lock:
                del self._reading[key]
            mine.set_exception(error)
            raise
        with self._lock:
            # Unless the matte was deleted meanwhile.
            if self._reading.pop(key, None) is mine:
                self._blocks[key] = block
                self.bytes += _size(block)
                while self.bytes > self._memory:
                    _, old = self._blocks.popitem(last=False)
                    self.bytes -= _size(old)
        mine.set_result(block)
        return block

    def places(self, id: str, threads: int) -> Places:
        """Where the pixels of a matte look, as `places_of` tells; of a few mattes it is kept."""
        with self._lock:
            found = self._places.get(id)
        if found is None:
            found = places_of(self.matte(id), lambda row, column: self.block(id, row, column), threads)
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
            for key in [key for key in self._blocks if key[0] == id]:
                self.bytes -= _size(self._blocks.pop(key))
            for key in [key for key in self._reading if key[0] == id]:
                del self._reading[key]


def _size(block: Block) -> int:
    return sum(getattr(block, field.name).nbytes for field in fields(block))
