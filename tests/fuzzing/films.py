"""Films, clips and captures with them: how damaged ones are made, and what must hold for the result."""

import asyncio
import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random

from storage.errors import CaptureError
from storage.layout import composites as stored_composites
from storage.layout import uploads
from storage.objects.store import Objects
from tests.fuzzing import changes, seeds
from tests.fuzzing.campaign import KEPT, LIMITS
from tests.fuzzing.seeds import Files
from tests.parts.captures import nested_program, zip_bytes
from tests.workflows.ingest.video.camera import Camera, capture, film, lights, overstated
from tests.workflows.mattes.imports.conftest import make_matte
from workflows.composite.video import steps as video_steps
from workflows.ingest import films
from workflows.ingest import steps as ingest_steps
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, Share
from workflows.jobs import Task
from workflows.simulation.glass_ball import glass_ball
from workflows.untrusted.decoder import Decoder

BOXES = b"|".join(
    (
        b"moov mvhd tkhd mdhd elst stsd stts ctts stsc stsz stco co64 stss avcC hvcC av1C avc1 colr pasp trex trun tfhd"
    ).split()
)
CHUNKS = b"RIFF|LIST|avih|strh|strf|idx1|movi|00dc|indx"
ELEMENTS = (
    rb"\x1a\x45\xdf\xa3|\x18\x53\x80\x67|\x16\x54\xae\x6b|\x1f\x43\xb6\x75|\xae|\xe0|\xa3|\x53\x78|\x63\xa2"
)
MARKS = b"|".join((BOXES, CHUNKS, ELEMENTS))


def damaged_film(random: Random, data: bytes) -> bytes:
    """A damaged film, or an MP4 whose index claims many more samples."""
    if b"stsz" in data and random.random() < 0.1:
        return overstated(data, int(2 ** random.uniform(4, 32)))
    return changes.damaged(random, data, MARKS)


def read_clip(data: bytes, folder: Path) -> None:
    file = io.BytesIO(data)
    with Decoder(LIMITS.image_bytes) as found:
        _, ticks, _ = films.times(found, file, "a.mp4", 2000)
        film, signatures, again, large = films.scan(found, file, "a.mp4", 1 << 20, 0.1)
        assert len(signatures) == len(again) >= len(large.frames)
        plan = [[Share(tick, TOTAL_WEIGHT)] for tick in ticks[:5].tolist()]
        for picture in films.means(found, file, "a.mp4", plan, film.width, film.height):
            assert picture.nbytes <= LIMITS.image_bytes


@cache
def store(folder: Path) -> Objects:
    objects = Objects((folder / KEPT).as_uri())
    make_matte(objects)
    return objects


def read_backdrop_clip(data: bytes, folder: Path) -> None:
    objects = store(folder)
    objects.put(stored_composites.clip_path("j"), data)
    try:
        task = Task("j", "", "m", {"transfer": "srgb", "placement": {}}, LIMITS)
        plan = video_steps.prepare(objects, task)
        json.dumps(plan, allow_nan=False)
        video_steps.work(objects, replace(task, plan=plan), 0)
    finally:
        objects.delete(stored_composites.path("j"))


PROGRAM = nested_program((64, 48), bands=((4, 3, 10),), levels=3)


def capture_files() -> dict[str, Files]:
    """Frames by file extension, and a film of `PROGRAM`."""
    camera = Camera(fps=20, hold=0.25, jitter=0.02, lead=0.5, tail=0.5)
    made = film(lights(glass_ball(32, 24, monitor=(64, 48), rays=4), PROGRAM), camera)
    stills = {
        ".png": seeds.pngs,
        ".jpg": seeds.jpegs,
        ".heic": seeds.heics,
        ".tif": seeds.tiffs,
        ".exr": seeds.exrs,
        ".dng": seeds.raws,
    }
    return {".mp4": (made.data,), **{end: make() for end, make in stills.items()}}


def make_capture(random: Random, valid: dict[str, Files]) -> bytes:
    """A capture archive with everything that one may contain, changed somewhere."""
    end = random.choice([*valid, *[".mp4"] * 4])
    one = random.choice(valid[end])
    if end == ".mp4":
        manifest, files = capture(PROGRAM, one, 4.0)
        broken = "clip.mp4"
    else:
        names = [f"{n}{end}" for n in range(11)]
        shown = [{"file": name, "pattern": n} for n, name in enumerate(names)]
        manifest = seeds.MANIFEST | {"frames": shown, "mask": None}
        files = {"a.png": valid[".png"][0], **dict.fromkeys(names, one)}
        broken = random.choice(names)
    text = json.dumps(manifest).encode()
    if random.random() < 0.3:
        text = changes.other_json(random, manifest)
    else:
        files[broken] = damaged_film(random, one) if end == ".mp4" else changes.damaged(random, one)
    return zip_bytes({"capture.json": text, **files})


def read_capture(data: bytes, folder: Path) -> None:
    objects = Objects((folder / "store").as_uri())

    async def put() -> None:
        async with objects.write(uploads.part_path("c", "all")) as writer:
            await writer.write(data)

    asyncio.run(put())
    uploads.seal(objects, "c", [uploads.Part("all", len(data))])
    try:
        task = Task("j", "c", "", {}, LIMITS)
        task = replace(task, plan=ingest_steps.prepare(objects, task))
        json.dumps(task.plan, allow_nan=False)
        for tile in range(task.plan["tiles"]):
            ingest_steps.work(objects, task, tile)
    except CaptureError as error:
        if not error.fields["entry"]:
            raise AssertionError("a capture's error names no entry") from error
        raise
