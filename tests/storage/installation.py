"""An installation with one item of every kind: rows, and objects as the service writes them."""

import asyncio

import numpy as np
from sqlalchemy import Connection, Engine

from storage.database.engine import writing
from storage.layout import composites, live
from storage.layout import mattes as stored_mattes
from storage.layout import uploads as stored_uploads
from storage.layout.captures import Stack, create_stack, write_slab
from storage.layout.uploads import Part
from storage.objects.store import Objects
from storage.records import api_keys, captures, idempotency, jobs, links, mattes, programs, tiles, uploads
from tests.storage.layout.matte_blocks import block, extent, places

SHAPE = (6, 21, 40, 3)
ARCHIVE = np.random.default_rng(4).bytes((2 << 20) + 777)
"""Has three blocks with checksums."""
RETRYABLE = {"status": 500, "detail": "gave up"}


def fill(engine: Engine, objects: Objects) -> None:
    """Fill an installation.

    It has the capture ``c`` and its matte ``m``, which has a link; ``i``, a capture that is being ingested from its
    archive; ``u``, an unfinished upload; the composites ``v``, which is done, ``w``, which is queued, and ``x``, which
    has failed and may be retried; ``l``, an imported matte; and ``r``, a matte that is being recovered.
    """
    rng = np.random.default_rng(3)
    create_stack(
        objects,
        "c",
        SHAPE,
        np.dtype("uint16"),
        memory=SHAPE[0] * 21 * 40 * 6,
        attributes={"patterns": [1, 0], "response": 2.2},
        mask=rng.random((21, 40)) < 0.5,
        images=[rng.random((3, 4, 1), np.float32)],
        shares=np.arange(9).reshape(3, 3),
    )
    for first in (0, 3):
        write_slab(objects, "c", first, rng.integers(0, 65536, (3, *SHAPE[1:]), np.uint16))
    stack = Stack(objects, "c")
    stack.annotate(noise={"gain": 0.1})
    stack.save()
    for matte in ("m", "l", "r"):
        given = {"monitor": [8, 6], "crosstalk": np.eye(3).tolist(), "options": {"method": "lobes"}}
        made = stored_mattes.create(objects, matte, height=21, width=40, columns=4, rows=3, **given)
        for row, column in places(made)[: 2 if matte == "r" else None]:
            made.write(row, column, block(*extent(made, row, column), seed=10 * row + column))
    live.write(objects, "m", "live-1", rng.bytes(1000))
    stream(objects, stored_uploads.part_path("i", "all"), ARCHIVE)
    stored_uploads.seal(objects, "i", [Part("all", len(ARCHIVE))])
    for part in ("p", "q"):
        stream(objects, stored_uploads.part_path("u", part), ARCHIVE[:999])
    stream(objects, composites.video_path("v"), ARCHIVE[:5000])
    for job in ("w", "x"):
        stream(objects, composites.clip_path(job), ARCHIVE[:6000])
        objects.put(composites.ticks_path(job), ARCHIVE[:80])
        objects.put(composites.segment_path(job, 0), ARCHIVE[:70])
    with writing(engine) as c:
        add_rows(c)
        api_keys.create(c, "lab", "alice", "write")


def add_rows(c: Connection) -> None:
    """Add the rows."""
    for job, kind, capture, matte in (
        ("ci", "ingest", "c", None),
        ("mr", "recover", "c", "m"),
        ("ii", "ingest", "i", None),
        ("rr", "recover", "c", "r"),
        ("v", "composite", "c", "m"),
        ("w", "composite", "c", "m"),
        ("x", "composite", "", "l"),
    ):
        jobs.add(
            c,
            kind,
            capture,
            {"é": None},
            matte,
            job=job,
            webhook="https://example.org" if job == "v" else None,
        )
        tiles.add_steps(c, job)
    for job in ("rr", "ii"):
        jobs.enter_stage(c, job, "recovering")
        tiles.add_plan(c, job, {"tiles": 6})
    tiles.mark_done(c, "rr", [(0, 0.5, 16), (1, 0.25, 16)])
    captures.add(c, "c", "ci", name="ball \u2713", bytes=5, frames=6, program={"levels": [0.25, 1e-300]})
    captures.change(c, "c", state="ready", owner="alice")
    captures.add(c, "i", "ii", name="", bytes=len(ARCHIVE), frames=6, program={}, seconds=1e6)
    mattes.add(c, "m", "c", "mr", {"method": "none"}, name="ball \u2713")
    mattes.change(c, "m", state="ready", figures={"width": 40})
    links.create(c, "m", 1e6)
    mattes.add(c, "r", "c", "rr", {})
    mattes.add_imported(c, "l", {}, {"width": 40}, stored=9)
    uploads.add(c, "u", 3000, "filename x", 1e6, "once")
    uploads.advance(c, "u", 0, [Part("p", 999), Part("q", 999)], 1e6)
    for job in ("ci", "mr", "v"):
        jobs.end(c, job, "succeeded")
    jobs.end(c, "x", "failed", RETRYABLE)
    idempotency.add(c, "key", "POST /v1/captures", "c")
    programs.add(c, {"any": 1})


def stream(objects: Objects, path: str, data: bytes, piece: int = 70_000) -> None:
    """Write an object in pieces, as an upload is written."""

    async def write() -> None:
        async with objects.write(path) as file:
            for at in range(0, len(data), piece):
                await file.write(data[at : at + piece])

    asyncio.run(write())


def flip(objects: Objects, path: str, at: float = 0.5) -> None:
    """Flip a bit of an object at a share of its length."""
    data = bytearray(objects.read_raw(path))
    data[min(int(len(data) * at), len(data) - 1)] ^= 0x10
    objects.write_raw(path, iter([bytes(data)]))


def contents(objects: Objects) -> dict[str, bytes]:
    """The bytes of every object, by path."""
    folders = ("captures", "mattes", "uploads", "composites")
    return {path: objects.read_raw(path) for folder in folders for path in objects.sizes(folder)}
