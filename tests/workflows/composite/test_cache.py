"""Strips of mattes in memory: bounded, and read once."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.mattes import Block, Matte, empty_block
from storage.objects.store import Objects
from workflows.composite import cache as cache_module
from workflows.composite.cache import Cache
from workflows.composite.strips import LENGTH, Strip, read_strip

EDGE = 32


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """Of 4 rows of two strips, of which the second has two blocks; each block with its number in S."""
    width = LENGTH + 2 * EDGE
    given = {"monitor": [8, 6], "crosstalk": np.eye(3).tolist()}
    made = mattes.create(objects, "m", height=128, width=width, columns=8, rows=6, **given)
    assert made.block == EDGE
    for row in range(4):
        for column in range(made.block_columns):
            black = empty_block(EDGE, EDGE)
            made.write(
                row, column, replace(black, S=black.S + 100 * row + column, recovered=~black.recovered)
            )
    return made


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The row and number of every strip that a cache reads from the store."""
    found: list[tuple[int, int]] = []

    def counted(matte: Matte, row: int, number: int, *there: Any) -> Strip:
        found.append((row, number))
        return read_strip(matte, row, number, *there)

    monkeypatch.setattr(cache_module, "read_strip", counted)
    return found


def number(strip: Strip) -> float:
    return float(strip.S[0, 0, 0])


def test_least_recently_used_strips_are_dropped(
    objects: Objects, matte: Matte, reads: list[tuple[int, int]]
) -> None:
    one = read_strip(matte, 0, 0).nbytes
    cache = Cache(objects, 3 * one)
    for row in (0, 1, 2, 0, 3):
        assert number(cache.strip("m", row, 0)) == 100 * row
    assert (len(reads), cache.bytes) == (4, 3 * one)
    cache.strip("m", 0, 0)
    assert len(reads) == 4
    cache.strip("m", 1, 0)
    assert len(reads) == 5
    assert number(Cache(objects, 0).strip("m", 1, 1)) == 108


def test_a_strip_of_an_unfinished_matte_is_read_again_once_it_has_more_blocks(
    objects: Objects, matte: Matte, reads: list[tuple[int, int]]
) -> None:
    cache = Cache(objects, 1 << 30)
    there = {(0, 0), (0, 2)}
    for _ in range(2):
        strip = cache.strip("m", 0, 0, there)
        assert strip.recovered.all(axis=0).nonzero()[0].tolist() == [*range(EDGE), *range(2 * EDGE, 3 * EDGE)]
        assert strip.S[:, ~strip.recovered[0]].max() == 0
    assert len(reads) == 1
    assert cache.strip("m", 0, 0, there | {(0, column) for column in range(LENGTH // EDGE)}).recovered.all()
    assert cache.strip("m", 0, 0).recovered.all()
    assert len(reads) == 2


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
        return number(cache.strip("m", 2, 1))

    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(ask, range(8))) == [208] * 8
    assert reads == [(2, 8), (2, 9)]


def test_missing_block_is_an_error_for_all_readers_and_read_again_later(objects: Objects) -> None:
    made = mattes.create(objects, "n", height=16, width=16, columns=8, rows=6, crosstalk=np.eye(3).tolist())
    cache = Cache(objects, 1 << 20)
    with ThreadPoolExecutor(4) as threads:
        for one in [threads.submit(cache.strip, "n", 0, 0) for _ in range(4)]:
            assert isinstance(one.exception(), Corrupt)
    made.write(0, 0, empty_block(16, 16))
    assert number(cache.strip("n", 0, 0)) == 0


def test_matte_deleted_while_it_is_read_is_an_error_for_all_readers(
    objects: Objects, matte: Matte, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache, gate = Cache(objects, 1 << 20), threading.Event()

    def deleted(self: Matte, row: int, column: int) -> Block:
        gate.wait(120)
        cache.forget("m")
        raise Corrupt("some of it is missing")

    monkeypatch.setattr(Matte, "read", deleted)
    with ThreadPoolExecutor(4) as threads:
        strips = [threads.submit(cache.strip, "m", 0, 0) for _ in range(4)]
        time.sleep(0.1)
        gate.set()
        for one in strips:
            assert isinstance(one.exception(10), Corrupt)


def test_nothing_is_kept_of_a_matte_that_is_forgotten(objects: Objects, matte: Matte) -> None:
    cache = Cache(objects, 1 << 30)
    cache.strip("m", 0, 0)
    cache.places("m", 1)
    cache.forget("m")
    assert cache.bytes == 0
    objects.delete(mattes.path("m"))
    for read in (lambda: cache.strip("m", 0, 0), lambda: cache.places("m", 1)):
        with pytest.raises(Corrupt, match="m is not in the store"):
            read()


def test_a_read_that_outlives_its_matte_leaves_the_next_read_alone(
    objects: Objects, matte: Matte, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache, begun, ended = Cache(objects, 1 << 30), threading.Event(), threading.Event()
    later: list[Future[Strip]] = []

    def read(*given: Any) -> Strip:
        if later:
            begun.set()
            assert ended.wait(120)
        else:
            cache.forget("m")
            later.append(thread.submit(cache.strip, "m", 0, 0))
            assert begun.wait(120)
        return read_strip(*given)

    monkeypatch.setattr(cache_module, "read_strip", read)
    with ThreadPoolExecutor(1) as thread:
        cache.strip("m", 0, 0)
        ended.set()
        assert later[0].result(120).nbytes == cache.bytes


def test_mattes_that_were_not_used_for_long_are_opened_again(
    objects: Objects, matte: Matte, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache_module, "OPEN", 2)
    for id in ("n", "o"):
        mattes.create(objects, id, height=16, width=16, columns=8, rows=6, crosstalk=np.eye(3).tolist())
    cache = Cache(objects, 1 << 20)
    first, second = cache.matte("m"), cache.matte("n")
    assert cache.matte("m") is first
    cache.matte("o")
    assert cache.matte("m") is first
    assert cache.matte("n") is not second
