"""The steps of a job that composites the frames of a clip and makes a video of them.

Frames keep their times, to the tick of the clip's clock, and none is invented. Where frames can't be decoded, the one
before stays for as long as they would have been shown, as in a player. A clip that was cut short gives a shorter video.
The job's log says what was lost. Sound is left out.
"""

import asyncio
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.errors import CaptureError, ClipError, Corrupt
from storage.layout import composites
from storage.layout.mattes import Matte
from storage.objects.byte_objects import PART
from storage.objects.event_loop import gather
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.composite.backdrops.around import expose, over_frame, put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.backdrops.placement import Placement
from workflows.composite.cache import Cache
from workflows.composite.engine import Window
from workflows.composite.quantise import encode
from workflows.composite.video import segments
from workflows.images import tone_curves
from workflows.ingest import films
from workflows.ingest.films import Film
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, Share
from workflows.jobs import Steps, Task
from workflows.untrusted.decoder import Decoder

NAME = "the clip"
"""What errors call it."""
KEPT = 1 << 29
"""Bytes of a matte that a worker keeps from frame to frame."""
MOST = 1_000_000
"""Frames of a clip, at most: nine hours at 30 a second."""
SHORTEST, LONGEST = 16, 64
"""Frames of a tile: enough to be worth seeking, few enough for a tile to take seconds."""
PIXELS = 8_000_000
"""Pixels of a tile, of its frames and of what is composited of them, about."""
CLOCK = 20_000
"""Ticks a second of an MP4 at least, about, where the clip has fewer; it counts those of a frame in 32 bits."""
SHORT = 0.5
"""Seconds that may lack at the end without a note: containers round, and include their sound."""


def prepare(objects: Objects, task: Task) -> dict[str, Any]:
    """Read through a clip, and store when its frames are shown.

    Returns
    -------
    dict
        ``tiles``: their number; ``length``: frames of one; ``frames``, ``width``, ``height``: of the clip;
        ``tick``: seconds of a tick, as numerator and denominator; ``last``: ticks of the last frame; ``rate``: frames a
        second, about; ``notes``: lines for the job's log.

    Raises
    ------
    ClipError
        If the clip can't be read.
    """
    target = Matte(objects, task.matte)
    with _reading(objects, task) as (decoder, file):
        film, ticks, last = films.times(decoder, file, NAME, MOST)
    tick, width, height = film.time_base, film.width, film.height
    if film.interlaced:
        raise ClipError(
            "the clip is interlaced: each frame holds two pictures of different times, in alternate rows. Deinterlace "
            "it with a video editor, or by `ffmpeg -i clip.mts -vf bwdif clip.mp4`, and send the result"
        )
    gaps = np.append(np.diff(ticks), last)
    longest = int(np.argmax(gaps))
    shown = float(gaps[longest] * tick)
    if shown * max(tick.denominator, CLOCK) >= 1 << 31:
        raise ClipError(
            f"by its timestamps frame {longest} of the clip is shown for {shown:.0f} s, in ticks of {tick} s, which no "
            "MP4 can hold: export the clip again with a video editor"
        )
    objects.put(composites.ticks_path(task.job), ticks.astype("<i8").tobytes())
    pixels = width * height + target.width * target.height
    length = int(np.clip(PIXELS // pixels, SHORTEST, LONGEST))
    seconds = float((ticks[-1] + last - ticks[0]) * tick)
    return {
        "tiles": -(-len(ticks) // length),
        "length": length,
        "frames": len(ticks),
        "width": width,
        "height": height,
        "tick": [tick.numerator, tick.denominator],
        "last": last,
        "rate": int(np.clip(round(len(ticks) / seconds), 1, 240)),
        "notes": [
            f"the clip has {len(ticks)} frames of {width} x {height} pixels, {seconds:.3f} s",
            *_losses(film, ticks, last),
        ],
    }


def work(objects: Objects, task: Task, tile: int) -> int:
    """Composite the frames of a tile, and store them as a segment; returns the number of their pixels.

    Raises
    ------
    ClipError
        If a frame that was there when the clip was looked over can't be decoded again.
    """
    transfer, length = task.options["transfer"], task.plan["length"]
    ticks = _ticks(objects, task.job)[tile * length : (tile + 1) * length]
    cache = Cache(objects, KEPT)
    matte, read = cache.matte(task.matte), partial(cache.strip, task.matte)
    light = tone_curves.table(transfer, np.dtype(np.uint16))
    # Jobs of earlier versions lack both.
    has_around, fits_frame = task.options.get("around") == "backdrop", task.options.get("fit") == "frame"
    stated = Placement(**task.options["placement"])
    placement = None if stated == Placement() else stated
    if fits_frame:
        placement = over_frame(matte, placement)

    def shown(frame: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """An 8 bit picture; where the mask left the matte out, it is black or shows the backdrop."""
        backdrop = Backdrop(frame, light)
        picture = composite(matte, backdrop, placement=placement, read=read, threads=1)
        if fits_frame:
            picture = expose(matte, picture)
        if has_around:
            picture = put_around(matte, backdrop, placement, picture, Window.of(matte), threads=1)
        return encode(picture, transfer, np.dtype(np.uint8), 1, 3).astype(np.uint8, copy=False)

    with _reading(objects, task) as (decoder, file):
        plan = [[Share(tick, TOTAL_WEIGHT)] for tick in ticks.tolist()]
        frames = films.means(decoder, file, NAME, plan, task.plan["width"], task.plan["height"])
        pictures = (shown(frame) for frame in frames)
        segment = segments.encode(pictures, task.plan["rate"], length, transfer)
    objects.put(composites.segment_path(task.job, tile), segment)
    return len(ticks) * matte.width * matte.height


def missing(objects: Objects, task: Task) -> list[int]:
    """The segments that are not in the store."""
    return composites.missing(objects, task.job, task.plan["tiles"])


def finish(objects: Objects, task: Task) -> dict[str, Any]:
    """Join the segments into the video."""
    job, plan = task.job, task.plan
    found = (_whole(objects, composites.segment_path(job, tile)) for tile in range(plan["tiles"]))
    # Without a name: nothing stays of it when this process is killed.
    with tempfile.TemporaryFile() as file:
        segments.join(found, _ticks(objects, job), plan["last"], Fraction(*plan["tick"]), file)
        file.seek(0)
        gather(_store(objects, composites.video_path(job), file))
    return {}


STEPS = Steps("composite", "compositing", prepare, work, missing, finish, scattered=False)


def _losses(film: Film, ticks: NDArray[np.int64], last: int) -> Iterator[str]:
    """What a clip lacks, as lines for the log."""
    tick = float(film.time_base)
    if film.lost:
        first, final = film.lost[0] * tick, film.lost[-1] * tick
        yield (
            f"frames between {first:.3f} s and {final:.3f} s can't be decoded, because the clip is damaged there: the "
            "frame before stays in their place"
        )
    ends = (int(ticks[-1]) + last) * tick
    if film.stated_duration > ends + SHORT:
        yield (
            f"the clip ends early: it should be {film.stated_duration:.3f} s long, but its last frame that can be "
            f"decoded ends at {ends:.3f} s; the video ends there"
        )


@contextmanager
def _reading(objects: Objects, task: Task) -> Iterator[tuple[Decoder, BinaryIO]]:
    """A decoder and the clip of a job, whose faults are raised as `ClipError`."""
    try:
        file = objects.read(composites.clip_path(task.job))
    except FileNotFoundError as error:
        raise Corrupt("the clip is no longer in the store; send it again") from error
    try:
        with file, Decoder(task.limits.image_bytes) as decoder:
            yield decoder, file
    except CaptureError as error:
        fields = {name: value for name, value in error.fields.items() if name != "entry"}
        raise ClipError(error.detail, **fields) from error


def _ticks(objects: Objects, job: str) -> NDArray[np.int64]:
    return np.frombuffer(_whole(objects, composites.ticks_path(job)), "<i8").astype(np.int64)


def _whole(objects: Objects, path: str) -> bytes:
    try:
        with objects.read(path) as file:
            return file.read()
    except FileNotFoundError as error:
        raise Corrupt(f"{path} is missing in the store; composite the clip again") from error


async def _store(objects: Objects, path: str, file: BinaryIO) -> None:
    async with objects.write(path) as target:
        while data := await asyncio.to_thread(file.read, PART):
            await target.write(data)
