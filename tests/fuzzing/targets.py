"""Every parser of untrusted input: how its input is made, and what must hold for its result."""

import asyncio
import io
import json
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from PIL import Image
from starlette.requests import Request

from services.api.captures import tus
from services.api.http.media_types import preferred, require_media_type
from services.api.http.responses import etag_matches
from services.api.mattes import clips as clips_api
from services.api.mattes import composites as composites_api
from services.runtime.problems import problem_of
from services.runtime.tracing import TRACEPARENT
from services.webhooks import safe_http
from storage.errors import ArchiveError, CaptureError, InvalidInput
from storage.layout import composites as stored_composites
from storage.layout import uploads
from storage.layout.matte_archive import Archive
from storage.objects.checksums import seal
from storage.objects.store import Objects
from tests.fuzzing import changes, requests, seeds
from tests.fuzzing.campaign import GUARDED, KEPT, MEMORY, Refused, Target
from tests.parts.captures import nested_program, zip_bytes
from tests.workflows.ingest.video.camera import Camera, capture, film, lights, overstated
from tests.workflows.mattes.imports.conftest import make_matte, pack_chunk, signed, unpack_chunk, unpacked
from workflows.composite import composite
from workflows.composite.backdrop import backdrop_of
from workflows.composite.video import steps as video_steps
from workflows.images import camera_raw, decode, float_formats, integer_formats
from workflows.ingest import steps as ingest_steps
from workflows.ingest.archive import CaptureArchive
from workflows.ingest.video.decoder import open_clip
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, Share, mean_frames
from workflows.ingest.video.signatures import take_signatures
from workflows.jobs import Task
from workflows.mattes.imports.importing import take_in
from workflows.mattes.options import parse_options
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball
from workflows.untrusted import zip_files
from workflows.untrusted.limits import Limits

LIMITS = Limits(unpacked=1 << 22, memory=1 << 22, frames=20_000, pixels=1 << 20)
Files = tuple[bytes, ...]
"""Valid files."""


def refusing(read: Callable[[bytes, Path], object], data: bytes, folder: Path) -> None:
    """Run a parser; an error that the API can report as a problem counts as a refusal."""
    try:
        read(data, folder)
    except InvalidInput as error:
        json.dumps(problem_of(error), ensure_ascii=False, allow_nan=False).encode()
        raise Refused from error


def of_files(
    marks: bytes | None = None, *others: Callable[[Random, bytes], bytes]
) -> Callable[[Random, Files], bytes]:
    """Makes damaged files out of valid ones, half of the time by one of `others` if given."""
    return partial(_of_files, marks, others)


def _of_files(
    marks: bytes | None,
    others: Sequence[Callable[[Random, bytes], bytes]],
    random: Random,
    whole: Files,
) -> bytes:
    one = random.choice(whole)
    if others and random.random() < 0.5:
        return random.choice(others)(random, one)
    return changes.damaged(random, one, marks, random.choice(whole))


# Archives


def make_zip(random: Random, whole: Files) -> bytes:
    return changes.damaged_zip(random, seeds.record_files(), lambda r, name, data: changes.damaged(r, data))


def read_zip(data: bytes, folder: Path) -> None:
    archive = zip_files.open_archive(io.BytesIO(data), CaptureError)
    for info in zip_files.entries(archive, 100, LIMITS.unpacked, CaptureError).values():
        assert len(zip_files.read(archive, info, 1 << 16, CaptureError)) <= info.file_size


def make_bundle(random: Random, whole: Files) -> bytes:
    record = random.choice((seeds.RECORD, seeds.FILMED))
    files = seeds.record_files(record)
    if random.random() < 0.3:
        return changes.damaged_zip(random, files, lambda r, name, data: changes.damaged(r, data))
    return zip_bytes(files | {"capture.json": changes.other_json(random, record)}, zipfile.ZIP_DEFLATED)


def read_bundle(data: bytes, folder: Path) -> None:
    bundle = CaptureArchive(io.BytesIO(data), LIMITS)
    manifest = bundle.manifest
    for name in {frame.file for frame in manifest.frames}:
        bundle.read(name)
    if manifest.video is not None:
        with bundle.open(manifest.video.file) as file:
            file.read()
    use_program(manifest.program)
    json.dumps(manifest.program.model_dump(mode="json"), allow_nan=False).encode()


def use_program(program: Program) -> None:
    """What the API does with an archive before a job reads it."""
    assert program.count > len(program.constants[0]) > 1
    program.bands()
    assert Program.model_validate(program.model_dump(mode="json")) == program


def make_program(random: Random, whole: Files) -> bytes:
    return changes.other_json(random, seeds.RECORD["program"])


def read_program(data: bytes, folder: Path) -> None:
    try:
        program = Program.model_validate_json(data)
    except ValueError as error:
        raise Refused from error
    use_program(program)
    pixels = program.monitor.width * program.monitor.height
    if pixels <= 1 << 20 and not any(part.kind == "images" for part in program.parts):
        for picture in islice(program.pictures(0, program.count), 3):
            assert picture.shape[:2] == (program.monitor.height, program.monitor.width)


# Mattes


@cache
def archive_files() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        objects = Objects(Path(folder).as_uri())
        make_matte(objects)
        return unpacked(b"".join(Archive(objects, "m")))


def make_archive(random: Random, whole: dict[str, bytes]) -> bytes:
    files = dict(whole)
    kind = random.randrange(4)
    if kind == 0:
        return changes.damaged_zip(random, files, lambda r, name, data: changes.damaged(r, data))
    name = random.choice([*files])
    if name.endswith(".json"):
        files[name] = changes.other_json(random, json.loads(files[name]))
        if random.random() < 0.8:  # with a correct checksum, if it still has one
            with suppress(ValueError, TypeError, AttributeError, RecursionError):
                files[name] = seal(files[name])
    elif kind == 1:
        files[name] = changes.damaged(random, files[name])
    else:
        change = random.choice((changes.damaged, changes.other_float))
        files[name] = pack_chunk(change(random, unpack_chunk(files[name])))
    if random.random() < 0.1:
        del files[random.choice([*files])]
    try:
        return signed(files)
    except (ValueError, TypeError, KeyError, RecursionError):  # the manifest itself is changed
        return zip_bytes(files)


def read_archive(data: bytes, folder: Path) -> None:
    objects = Objects((folder / "store").as_uri())
    try:
        matte = take_in(io.BytesIO(data), objects, "n", replace(LIMITS, memory=1 << 20))
    except ArchiveError:
        assert objects.paths_below("mattes/n") == set()
        raise
    assert matte.width * matte.height < 1 << 20
    light = np.linspace(0, 1, 5 * 40 * 3, dtype=np.float32).reshape(5, 40, 3)
    assert np.isfinite(composite(matte, light, threads=1)).all()
    again = b"".join(Archive(objects, "n"))
    take_in(io.BytesIO(again), objects, "o", LIMITS)


# Pictures


def read_image(data: bytes, folder: Path) -> None:
    pixels = integer_formats.decode(data, memory=LIMITS.image)
    assert pixels.dtype in (np.uint8, np.uint16)
    assert pixels.ndim == 3
    assert pixels.shape[2] in (1, 3)
    assert 0 < pixels.nbytes <= LIMITS.image


def read_any_backdrop(data: bytes, folder: Path) -> None:
    backdrop = backdrop_of(decode.decode(data, "srgb", memory=LIMITS.image), "srgb")
    pixels = backdrop.pixels
    assert pixels.ndim == 3
    assert 0 < pixels.nbytes <= 4 * LIMITS.image
    assert np.isfinite(pixels).all()


def read_floats(data: bytes, folder: Path) -> None:
    if not float_formats.is_float(data):
        raise Refused
    light = float_formats.decode(data, memory=LIMITS.image)
    assert light.dtype == np.float32
    assert light.ndim == 3
    assert light.shape[2] in (1, 3)
    assert 0 < light.nbytes <= LIMITS.image


def read_raw(data: bytes, folder: Path) -> None:
    light = camera_raw.decode(data, memory=LIMITS.image)
    assert light.dtype == np.float32
    assert light.ndim == 3
    assert light.shape[2] == 3
    assert light.nbytes <= LIMITS.image


def make_raw(random: Random, whole: Files) -> bytes:
    if random.random() < 0.3:
        body = random.choice((b"", random.choice(whole)))
        other = random.choice(seeds.MAGICS) + body + random.randbytes(random.choice((16, 200, 4000)))
        return changes.damaged(random, other)
    return random.choice((changes.damaged, changes.damaged_tiff))(random, random.choice(whole))


def profiled(random: Random, data: bytes) -> bytes:
    """A PNG with a damaged colour profile."""
    target = io.BytesIO()
    profile = changes.damaged(random, seeds.profile(), rb"desc|curv|para|XYZ |A2B0|B2A0|mft2|TRC")
    Image.open(io.BytesIO(seeds.pngs()[0])).save(target, "PNG", icc_profile=profile)
    return target.getvalue()


# Films

ATTRIBUTES = rb"chlist\0|box2i\0|tiledesc\0|compression\0|string\0|lineOrder\0"
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
    def clip() -> Any:
        return open_clip(io.BytesIO(data), "a.mp4", LIMITS.image)

    with clip() as found:
        ticks, _ = found.ticks(2000)
    assert (np.diff(ticks) > 0).all()
    with clip() as found:
        signatures, again, large = take_signatures(found, 1 << 20, 0.1)
    assert len(signatures) == len(again) >= len(large.frames)
    with clip() as found:
        for picture in mean_frames(found, [[Share(tick, TOTAL_WEIGHT)] for tick in ticks[:5].tolist()]):
            assert picture.shape == (found.height, found.width, 3)
            assert picture.nbytes <= LIMITS.image


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
        ".tif": seeds.tiffs,
        ".exr": seeds.exrs,
        ".dng": seeds.raws,
    }
    return {".mp4": (made.data,), **{end: make() for end, make in stills.items()}}


def make_capture(random: Random, whole: dict[str, Files]) -> bytes:
    """A capture archive with everything that one may contain, changed somewhere."""
    end = random.choice([*whole, *[".mp4"] * 4])
    one = random.choice(whole[end])
    if end == ".mp4":
        record, files = capture(PROGRAM, one, 4.0)
        broken = "clip.mp4"
    else:
        names = [f"{n}{end}" for n in range(11)]
        shown = [{"file": name, "pattern": n} for n, name in enumerate(names)]
        record = seeds.RECORD | {"frames": shown, "mask": None}
        files = {"a.png": whole[".png"][0], **dict.fromkeys(names, one)}
        broken = random.choice(names)
    text = json.dumps(record).encode()
    if random.random() < 0.3:
        text = changes.other_json(random, record)
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


# Requests

HEADERS = (
    "Upload-Length: 100",
    "Upload-Offset: 0",
    "Upload-Checksum: sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
    "Upload-Metadata: filename YS56aXA=,is_confidential,name w6k=",
    "Content-Type: application/offset+octet-stream; charset=utf-8",
    "Tus-Resumable: 1.0.0",
    "Range: bytes=10-20",
    "Range: bytes=-5",
    'If-None-Match: "abc", W/"d", *',
    "Accept: image/png;q=0.5, image/x-exr;q=0.9, */*;q=0.1",
    "traceparent: 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
)


def make_headers(random: Random, whole: Files) -> bytes:
    lines = random.sample(HEADERS, random.randrange(1, 6))
    return "\n".join(requests.other_text(random, line) for line in lines).encode("latin-1", "replace")


def read_headers(data: bytes, folder: Path) -> None:
    pairs = [line.partition(b":")[::2] for line in data.split(b"\n")]
    headers = [(name.lower(), value.strip()) for name, value in pairs]
    request = Request({"type": "http", "method": "GET", "path": "/", "headers": headers})
    start, end = clips_api._span(request.headers.get("range", ""), 1000)
    assert start >= 0
    assert start >= 1000 or start < end <= 1000
    etag_matches(request.headers, '"abc"')
    TRACEPARENT.fullmatch(request.headers.get("traceparent", ""))
    readers: dict[str, Callable[[], object]] = {
        "upload-checksum": lambda: tus.Checksum.of(request),
        "upload-metadata": lambda: tus.metadata_of(request),
        "upload-length": lambda: tus.byte_count(request, "Upload-Length"),
        "content-type": lambda: require_media_type(request, tus.CHUNK, "the bytes of an upload"),
        "accept": lambda: preferred(request.headers["accept"], composites_api.ANSWERS),
    }
    refused = None
    for name in readers.keys() & request.headers.keys():
        try:
            readers[name]()
        except InvalidInput as error:
            refused = error
    if refused is not None:
        raise refused


OPTIONS = {
    "method": "lobes",
    "tile": 64,
    "quality": "fast",
    "most_lobes": 2,
    "resolution": 1.1,
    "doubt": 0.5,
    "least_weight": 0.001,
}


def make_options(random: Random, whole: Files) -> bytes:
    return changes.other_json(random, random.choice((OPTIONS, OPTIONS | {"method": "nn-dgsr"})))


def read_options(data: bytes, folder: Path) -> None:
    try:
        given = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Refused from error
    if not isinstance(given, dict):
        raise Refused
    options = parse_options(given)
    json.dumps(options.model_dump(mode="json"), allow_nan=False)
    assert parse_options(options.model_dump(mode="json")) == options


URLS = (
    "https://example.org/hook?a=1",
    "https://93.184.216.34:8443/",
    "http://[::ffff:127.0.0.1]:80/x",
    "https://0x7f.1/",
    "https://xn--bcher-kva.example/é",
)


def make_url(random: Random, whole: Files) -> bytes:
    return requests.other_text(random, random.choice(URLS)).encode("utf-8", "surrogatepass")


def read_url(data: bytes, folder: Path) -> None:
    safe_http.check_url(data.decode("utf-8", "replace"), private=bool(data and data[0] & 1))


def target(
    name: str,
    make: Callable[[Random, Any], bytes],
    read: Callable[[bytes, Path], object],
    whole: Callable[[], Any] = tuple,
    quick: int = 300,
    memory: int = MEMORY,
) -> Target:
    return Target(name, make, partial(refusing, read), whole, quick, memory)


ALL = (
    target("zip", make_zip, read_zip),
    target("bundle", make_bundle, read_bundle),
    target("program", make_program, read_program),
    target("options", make_options, read_options),
    target("headers", make_headers, read_headers, quick=1000),
    target("url", make_url, read_url, quick=1000),
    target("requests", requests.make, requests.read, quick=100),
    target("png", of_files(rb"IHDR|PLTE|IDAT|tRNS|iCCP", changes.damaged_png), read_image, seeds.pngs),
    target("jpeg", of_files(rb"\xff[\xc0-\xff]"), read_image, seeds.jpegs),
    target("tiff", of_files(None, changes.damaged_tiff), read_image, seeds.tiffs),
    target("backdrop", of_files(rb"IHDR|iCCP|ICC_PROFILE", profiled), read_any_backdrop, seeds.backdrops),
    target("float-tiff", of_files(None, changes.damaged_tiff), read_floats, seeds.float_tiffs),
    target("exr", of_files(ATTRIBUTES), read_floats, seeds.exrs),
    target("raw", make_raw, read_raw, seeds.raws),
    target("video", of_files(MARKS, damaged_film), read_clip, seeds.clips, quick=60, memory=GUARDED),
    target("clip", of_files(MARKS, damaged_film), read_backdrop_clip, seeds.clips, quick=20, memory=GUARDED),
    target("archive", make_archive, read_archive, archive_files, quick=15),
    target("capture", make_capture, read_capture, capture_files, quick=20, memory=GUARDED),
)
