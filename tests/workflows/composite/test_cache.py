"""Blocks of mattes in memory: bounded, and read once."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from storage import mattes
from storage.errors import Corrupt
from storage.mattes import Block, Matte
from storage.objects import Objects
from workflows.composite.cache import Cache, _size

EDGE = 16


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """Of 4 x 4 blocks, each with its number in S."""
    made = mattes.create(objects, "m", height=64, width=64, columns=8, rows=6, crosstalk=np.eye(3).tolist())
    assert made.block == EDGE
    for row in range(4):
        for column in range(4):
            zero = np.zeros((EDGE, EDGE, 3), np.float32)
            flags = np.ones((EDGE, EDGE), bool)
            count = np.zeros((EDGE, EDGE, 3), np.uint32)
            empty = np.zeros(0, np.uint32), np.zeros(0, np.float32)
            S = zero + 4 * row + column
            made.write(row, column, Block(S, zero, zero[..., 0], flags, ~flags, count, *empty))
    return made


def number(block: Block) -> float:
    return float(block.S[0, 0, 0])


def test_what_was_asked_for_last_is_kept(objects: Objects, matte: Matte) -> None:
    one = _size(matte.read(0, 0))
    cache = Cache(objects, 3 * one)
    for column in (0, 1, 2, 0, 3):
        assert number(cache.block("m", 0, column)) == column
    assert (cache.hits, cache.misses, cache.bytes) == (1, 4, 3 * one)
    cache.block("m", 0, 0)
    assert cache.hits == 2
    cache.block("m", 0, 1)
    assert cache.misses == 5


def test_a_matte_of_twice_the_memory_is_read_all_the_same(objects: Objects, matte: Matte) -> None:
    one = _size(matte.read(0, 0))
    cache = Cache(objects, 8 * one)
    for _ in range(2):
        found = [number(cache.block("m", row, column)) for row in range(4) for column in range(4)]
        assert found == list(range(16))
        assert cache.bytes <= 8 * one
    assert number(Cache(objects, 0).block("m", 1, 1)) == 5


def test_threads_that_ask_for_the_same_read_it_once(
    objects: Objects, matte: Matte, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = []
    read = Matte.read

    def slowly(self: Matte, row: int, column: int) -> Block:
        reads.append((row, column))
        time.sleep(0.05)
        return read(self, row, column)

    monkeypatch.setattr(Matte, "read", slowly)
    cache, gate = Cache(objects, 1 << 20), threading.Barrier(8)

    def ask(_: int) -> float:
        gate.wait()
        return number(cache.block("m", 2, 3))

    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(ask, range(8))) == [11] * 8
    assert reads == [(2, 3)]


def test_a_block_that_is_missing_is_told_to_all_and_asked_for_again(objects: Objects) -> None:
    made = mattes.create(objects, "n", height=16, width=16, columns=8, rows=6, crosstalk=np.eye(3).tolist())
    cache = Cache(objects, 1 << 20)
    with ThreadPoolExecutor(4) as threads:
        for one in [threads.submit(cache.block, "n", 0, 0) for _ in range(4)]:
            assert isinstance(one.exception(), Corrupt)
    zero = np.zeros((16, 16, 3), np.float32)
    flags = np.zeros((16, 16), bool)
    count = np.zeros((16, 16, 3), np.uint32)
    empty = np.zeros(0, np.uint32), np.zeros(0, np.float32)
    made.write(0, 0, Block(zero, zero, zero[..., 0], flags, flags, count, *empty))
    assert number(cache.block("n", 0, 0)) == 0


def test_nothing_is_kept_of_a_matte_that_is_forgotten(objects: Objects, matte: Matte) -> None:
    cache = Cache(objects, 1 << 20)
    cache.block("m", 0, 0)
    cache.forget("m")
    assert cache.bytes == 0
    objects.delete(mattes.path("m"))
    with pytest.raises(Corrupt, match="m is not in the store"):
        cache.block("m", 0, 0)
