"""Measures the cost of checksums and the speed of `envmatte verify`, `backup` and `restore`.

A capture of 132 frames of 640 x 480 pixels with a camera's noise, and a matte of that size with 24 cells a pixel, are
written and read with and without checksums in turns; the best of several rounds counts. Seconds, and megabytes a
second, are of processor time in all threads, which depends little on other work on the machine; those of wall time say
so.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from storage.database.dialects import make_engine
from storage.database.engine import open_engine, writing
from storage.layout import captures as stored_captures
from storage.layout import mattes as stored_mattes
from storage.layout.captures import Stack, create_stack, write_slab
from storage.layout.mattes import Block, Matte
from storage.maintenance.backup import back_up
from storage.maintenance.restore import restore
from storage.maintenance.verify import verify
from storage.objects import zarr_store
from storage.objects.checksums import CODECS
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes

FRAMES, HEIGHT, WIDTH, CELLS = 132, 480, 640, 24


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = Objects((folder / "store").as_uri())
        reported = {what: [[], []] for what in ("write capture", "read capture", "write matte", "read matte")}
        frames, block = _frames(), _block()
        for _, checked in product(range(rounds), (False, True)):
            _use(CODECS if checked else CODECS[:1])
            for what, act in _acts(store, frames, block):
                reported[what][checked].append(_seconds(act)[0])
        print(f"{'CPU s':<16}{'without':>10}{'with':>10}")
        for what, (without, with_them) in reported.items():
            print(f"{what:<16}{min(without):>10.3f}{min(with_them):>10.3f}")
        _whole(folder, store, rounds)


def _use(codecs: Sequence[object]) -> None:
    for module in (stored_captures, stored_mattes, zarr_store):
        module.CODECS = codecs
    zarr_store.array_metadata.cache_clear()


def _frames() -> np.ndarray:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH][..., None]
    light = 110 + 70 * np.sin(x / 37 + np.arange(3)) * np.cos(y / 29)
    return np.stack(
        [(light + 4 * rng.standard_normal(light.shape, np.float32)).astype(np.uint8) for _ in range(FRAMES)]
    )


def _block() -> Block:
    rng = np.random.default_rng(1)
    edge = stored_mattes.block_edge(HEIGHT, WIDTH)
    S, rho = rng.random((2, edge, edge, 3), np.float32)
    count = np.zeros((edge, edge, 3), np.uint32)
    count[..., 0] = CELLS
    cell = np.sort(rng.integers(0, 16384, (edge * edge, CELLS), np.uint32)).ravel()
    weight = rng.random(edge * edge * CELLS, np.float32)
    true = np.ones((edge, edge), bool)
    return Block(S, rho, S[..., 0], true, true, count, cell, weight)


def _acts(store: Objects, frames: np.ndarray, block: Block) -> list[tuple[str, Callable[[], object]]]:
    options = {"memory": 2 * frames.nbytes, "attributes": {}, "mask": None, "images": ()}
    create_stack(store, "c", frames.shape, frames.dtype, **options)
    matte = stored_mattes.create(store, "m", height=HEIGHT, width=WIDTH, columns=128, rows=96)
    blocks = list(product(range(matte.block_rows), range(matte.block_columns)))
    return [
        ("write capture", lambda: write_slab(store, "c", 0, frames)),
        ("read capture", lambda: Stack(store, "c").read()),
        ("write matte", lambda: [matte.write(*at, block) for at in blocks]),
        ("read matte", lambda: [Matte(store, "m").read(*at) for at in blocks]),
    ]


def _whole(folder: Path, store: Objects, rounds: int) -> None:
    """Verify, back up and restore the data written last."""
    stack = Stack(store, "c")
    stack.save()
    engine = open_engine(f"sqlite:///{folder}/ledger.db")
    with writing(engine) as c:
        captures.add(c, "c", jobs.add(c, "ingest", "c", {}), name="", bytes=1, frames=FRAMES, program={})
        captures.change(c, "c", state="ready")
        mattes.add_imported(c, "m", {}, {})
    print(f"{'MB/s':<16}{'CPU':>10}{'wall':>10}")
    for what in ("verify", "backup", "restore"):
        best = [np.inf, np.inf]
        for n in range(rounds):
            target = Objects((folder / f"backup{n}").as_uri())
            other = Objects((folder / f"other{n}").as_uri())
            act = {
                "verify": lambda: verify(engine, store),
                "backup": lambda to=target: back_up(engine, store, to, "0"),
                "restore": lambda of=target, n=n, to=other: restore(
                    of, make_engine(f"sqlite:///{folder}/{n}.db"), to
                ),
            }[what]
            best = np.minimum(best, _seconds(act))
        size = verify(engine, store).read["bytes"] / 1e6
        print(f"{what:<16}{size / best[0]:>10.0f}{size / best[1]:>10.0f}")
    print(f"{size:.0f} MB stored, in {verify(engine, store).read['objects']} objects")


def _seconds(act: Callable[[], object]) -> tuple[float, float]:
    cpu, wall = time.process_time(), time.perf_counter()
    act()
    return time.process_time() - cpu, time.perf_counter() - wall


if __name__ == "__main__":
    main()
