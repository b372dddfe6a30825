"""The steps of an ingest job: each tile decodes a slab of frames and writes it into the capture's stack."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.errors import CaptureError
from storage.layout import captures, uploads
from storage.layout.captures import Stack, create_stack, write_slab
from storage.objects.store import Objects
from workflows.images import integer_formats
from workflows.images.resample import smallest_grid
from workflows.images.tone_curves import Response
from workflows.ingest import films, stills
from workflows.ingest.archive import CaptureArchive
from workflows.ingest.camera.border_exposure import BorderValues, strips_of
from workflows.ingest.camera.calibration import calibrate
from workflows.ingest.manifest import MANIFEST, Manifest, Video
from workflows.ingest.pixel_sample import take_sample
from workflows.ingest.plateau_sums import name_of
from workflows.ingest.report.survey import survey
from workflows.ingest.trial.frame_order import check_frames
from workflows.ingest.trial.qualities import try_qualities
from workflows.ingest.trial.steadiness import find_steadiness
from workflows.ingest.video.border_reader import LOOKS
from workflows.ingest.video.frame_means import Share
from workflows.ingest.video.matching import MAX_MATCHED, Expected, match_frames
from workflows.ingest.video.resemblance import coarse_light
from workflows.jobs import Steps, Task
from workflows.programs.parts import Images
from workflows.untrusted.decoder import Decoder
from workflows.untrusted.limits import Limits

MOST_SUMS = 2
"""Plateaus of a film whose frames are added up, at most, for each pattern."""


def prepare(objects: Objects, task: Task) -> dict[str, Any]:
    """Check the archive of a capture, match a video to its patterns, and create the empty stack.

    Returns
    -------
    dict
        ``tiles``: the number of slabs; ``slab``: frames in a slab; ``memory``: the limit that it follows from;
        ``width``, ``height`` and ``frames`` of the stack; ``video``: whether it is one; ``notes``: lines for the job's
        log about what was found in a video.

    Raises
    ------
    CaptureError
    """
    limits = task.limits
    with uploads.read(objects, task.capture) as file, Decoder(limits.image_bytes) as decoder:
        archive = CaptureArchive(file, limits)
        manifest = archive.manifest
        patterns = _decode_patterns(decoder, archive, limits)
        found = (
            _examine_stills(decoder, archive)
            if manifest.video is None
            else _examine_film(objects, task, decoder, archive, manifest.video, patterns)
        )
        mask = None if manifest.mask is None else _decode_mask(decoder, archive, manifest.mask, found)
    _check_size(manifest, found, limits)
    frames, height, width, _ = found.shape
    storage = found.storage
    has_border = manifest.video is not None and manifest.video.border is not None
    slab = create_stack(
        objects,
        task.capture,
        found.shape,
        storage.dtype,
        memory=limits.memory,
        attributes={
            "program": manifest.program.model_dump(mode="json"),
            # Float values are linear light, also if the response is unknown.
            "response": "linear"
            if storage.black
            else TypeAdapter(Response).dump_python(manifest.response, mode="json"),
            "storage": {"black": storage.black, "full": storage.full, "bounded": storage.bounded},
            **found.attributes,
            "border": has_border,
        },
        mask=mask,
        images=patterns,
        shares=found.shares,
        strips=strips_of(height, width) if has_border else None,
    )
    size = {"width": width, "height": height, "frames": frames, "video": manifest.video is not None}
    return {"tiles": -(-frames // slab), "slab": slab, "memory": limits.memory, **size, "notes": found.notes}


def _decode_patterns(decoder: Decoder, archive: CaptureArchive, limits: Limits) -> list[NDArray[np.float32]]:
    """The patterns that are images, in order, each file decoded once however often the program shows it."""
    names = [n for part in archive.manifest.program.parts if isinstance(part, Images) for n in part.files]
    images: dict[str, NDArray[np.float32]] = {}
    decoded = kept = 0
    for name in names:
        if name not in images:
            pixels = stills.read_integers(decoder, archive, name)
            decoded += pixels.nbytes
            if decoded > limits.unpacked:
                raise _too_large(name, limits.unpacked)
            images[name] = integer_formats.to_unit(smallest_grid(pixels))
        kept += images[name].nbytes
        if kept > limits.memory // 2:
            raise _too_large(name, limits.memory // 2)
    return [images[name] for name in names]


def _too_large(name: str, limit: int) -> CaptureError:
    return CaptureError(
        f"the image files of patterns, up to {name}, take more than {limit} bytes together: use fewer, smaller or "
        "coarser ones",
        entry=name,
        limit=limit,
    )


class _Frames(NamedTuple):
    """The frames of a capture as its stack will hold them.

    Attributes
    ----------
    shape : (int, int, int, int)
        Of the stack: frames, height, width and channels.
    storage : Storage
    attributes : dict
        Of the stack: which pattern each frame shows, its exposure, and how it was taken.
    shares : (k, 3) int64 or None
        As of `create_stack`; None for stills.
    notes : list of str
        Lines for the job's log.
    """

    shape: tuple[int, int, int, int]
    storage: stills.Storage
    attributes: dict[str, Any]
    shares: NDArray[np.int64] | None
    notes: list[str]


def _examine_stills(decoder: Decoder, archive: CaptureArchive) -> _Frames:
    """The frames that are stills, by the first of them."""
    frames = archive.manifest.frames
    header = stills.header(decoder, archive, frames[0].file)
    first = stills.read(decoder, archive, frames[0].file)
    height, width, channels = first.shape
    attributes = {
        "patterns": [frame.pattern for frame in frames],
        "exposures": [frame.exposure for frame in frames],
        "files": [frame.file for frame in frames],
        # One orientation for all frames: a camera that looks down detects its orientation at random.
        "orientation": header.orientation,
        "half_colour": header.half_colour,
        "stated_exposures": stills.exposures(decoder, archive),
    }
    storage = stills.storage_of(decoder, archive, first, header.transfer)
    return _Frames((len(frames), height, width, channels), storage, attributes, None, [])


def _examine_film(
    objects: Objects,
    task: Task,
    decoder: Decoder,
    archive: CaptureArchive,
    video: Video,
    patterns: Sequence[NDArray[np.float32]],
) -> _Frames:
    """The frames of a film, matched to the patterns."""
    manifest, entry = archive.manifest, video.file
    program = manifest.program
    if program.count > MAX_MATCHED:
        raise CaptureError(
            f"{entry} shows {program.count} patterns, more than the {MAX_MATCHED} that are found in a video: "
            "upload frames, or show fewer patterns",
            entry=entry,
            limit=MAX_MATCHED,
        )
    curve = "srgb" if program.monitor.response == "unknown" else program.monitor.response
    light = coarse_light(program, curve, patterns)
    every = None if video.border is None else 1 / (LOOKS * video.patterns_per_second)

    def put(name: str, data: memoryview) -> None:
        spare = objects.spare_bytes()
        # Only beside the stack, which takes twice as much. A bucket may be slower than to decode the frames again.
        if spare is not None and spare > 3 * program.count * len(data):
            uploads.put_sum(objects, task.capture, name, data)

    keep = films.KeepSums(1 / video.patterns_per_second, MOST_SUMS * program.count + 100, put)
    with archive.open(entry) as file:
        film, signatures, ticks, large = films.scan(
            decoder, file, entry, task.limits.memory // 4, every, keep
        )
    tick = float(film.time_base)
    expected = Expected(program, light, video, manifest.unfinished)
    filmed = match_frames(signatures, ticks, tick, large, expected)
    frames = len(filmed.shares)
    attributes = {"patterns": list(filmed.shares), "exposures": [1.0] * frames, "video": filmed.record}
    numbers, sent = program.constants
    coloured = set(numbers[np.ptp(sent, axis=1) > 0].tolist())  # their colours spill into white beside them
    shown = [share.tick for number, some in filmed.shares.items() if number not in coloured for share in some]
    full = films.full_scale(film, signatures[np.searchsorted(ticks, np.unique(shown))])
    storage = stills.Storage(np.dtype(np.uint16), 0, full, True)
    return _Frames((frames, film.height, film.width, 3), storage, attributes, filmed.table, filmed.notes)


def _decode_mask(decoder: Decoder, archive: CaptureArchive, entry: str, found: _Frames) -> NDArray[np.bool_]:
    """The pixels that are to be recovered, (height, width)."""
    mask = np.any(stills.read_integers(decoder, archive, entry), axis=2)
    _, height, width, _ = found.shape
    if mask.shape != (height, width):
        raise CaptureError(
            f"{entry} is {_size(mask)}, the frames are {width} x {height}"
            + (
                ", turned upright as the first of them says"
                if found.attributes.get("orientation", 1) > 1
                else ""
            ),
            entry=entry,
        )
    if not mask.any():
        raise CaptureError(
            f"{entry} is black everywhere: paint white what is to be recovered; transparency is not read",
            entry=entry,
        )
    return np.asarray(mask)


def _check_size(manifest: Manifest, found: _Frames, limits: Limits) -> None:
    """Check that the stack may be as large as it will be."""
    frames, height, width, _ = found.shape
    entry = manifest.frames[0].file if manifest.video is None else manifest.video.file
    limits.check_pixels(width, height, entry=entry)
    taken = math.prod(found.shape) * found.storage.dtype.itemsize
    if taken > limits.unpacked:
        raise CaptureError(
            f"{frames} frames of {width} x {height} pixels take {taken} bytes, more than the "
            f"{limits.unpacked} allowed: use fewer or smaller ones",
            entry=MANIFEST,
            field="frames" if manifest.video is None else "video",
            limit=limits.unpacked,
        )


def work(objects: Objects, task: Task, tile: int) -> int:
    """Decode the frames of a slab into the stack, and return the number of their pixels.

    Raises
    ------
    CaptureError
        Naming the frame that can't be decoded, or has another size or kind than the first.
    """
    stack, slab = Stack(objects, task.capture), task.plan["slab"]
    first, last = tile * slab, min((tile + 1) * slab, stack.frames)
    frames = np.empty((last - first, stack.height, stack.width, stack.channels), stack.dtype)
    with uploads.read(objects, task.capture) as file, Decoder(task.limits.image_bytes) as decoder:
        archive = CaptureArchive(file, task.limits)
        video, numbers = archive.manifest.video, range(first, last)
        read = (
            _still_frames(decoder, archive, stack, numbers)
            if video is None
            else _film_frames(objects, task.capture, decoder, archive, video.file, stack, numbers)
        )
        for n, pixels in read:
            frames[n - first] = pixels
    write_slab(objects, task.capture, first, frames)
    return int(frames.shape[0] * frames.shape[1] * frames.shape[2])


def missing(objects: Objects, task: Task) -> list[int]:
    """The slabs that are not in the store."""
    return Stack(objects, task.capture).missing()


def finish(objects: Objects, task: Task) -> dict[str, Any]:
    """Remove what interrupted workers left beside the stack, and measure the capture.

    Returns
    -------
    dict
        ``core_seconds`` that its recovery will take, by quality; None if too few pixels can be tried.
    """
    objects.sweep(captures.path(task.capture))
    stack = Stack(objects, task.capture)
    border = BorderValues.of(stack)
    check_frames(stack, border)
    stack.annotate(white_balance=None)  # a retried ingest must not find an old one
    calibrate(stack, border)
    seconds = _try_out(stack, border)
    survey(stack, border)
    stack.save()
    return {"core_seconds": seconds}


def _try_out(stack: Stack, border: BorderValues | None) -> dict[str, float] | None:
    """Find the steadiness of a stack, and what its recovery will take and be worth, from one sample of its pixels.

    Returns
    -------
    dict or None
        Seconds by quality. The stack is annotated with the intervals of composites.
    """
    sample = take_sample(stack)
    patterns = find_steadiness(stack, sample, border)
    tried = None if sample is None or patterns is None else try_qualities(stack, sample, patterns)
    if tried is None:
        return None
    stack.annotate(
        intervals={name: quality.interval and quality.interval._asdict() for name, quality in tried.items()}
    )
    return {name: quality.seconds for name, quality in tried.items()}


STEPS = Steps("ingest", "reading", prepare, work, missing, finish, scattered=False)


def _still_frames(
    decoder: Decoder, archive: CaptureArchive, stack: Stack, numbers: range
) -> Iterator[tuple[int, integer_formats.Codes]]:
    """Some frames of a stack of stills: their numbers and what they show."""
    shape = (stack.height, stack.width, stack.channels)
    storage = stills.Storage(stack.dtype, **stack.attributes["storage"])
    kind = np.dtype(np.float32) if storage.black else stack.dtype
    turn = stack.attributes.get("orientation", 1)  # missing from stacks of earlier versions
    for n in numbers:
        frame = archive.manifest.frames[n]
        pixels = stills.read(decoder, archive, frame.file, turn, storage.full)
        if pixels.shape != shape or pixels.dtype != kind:
            raise CaptureError(
                f"{frame.file} is {_size(pixels)} with {pixels.shape[2]} channels of {pixels.dtype}, the first "
                f"frame {stack.width} x {stack.height} with {stack.channels} of {kind}: all frames must "
                "be of one size and kind",
                entry=frame.file,
            )
        yield n, storage.encode(pixels)


def _film_frames(
    objects: Objects,
    capture: str,
    decoder: Decoder,
    archive: CaptureArchive,
    entry: str,
    stack: Stack,
    numbers: range,
) -> Iterator[tuple[int, integer_formats.Codes]]:
    """Some frames of a film's stack, in any order: their numbers and what they show."""
    shares, kept = stack.shares(), uploads.sums(objects, capture)
    size = stack.width, stack.height, stack.attributes["storage"]["full"]
    summed: dict[int, str] = {}
    lacking: dict[int, list[Share]] = {}
    for n in numbers:
        plan = [Share(*row) for row in shares[shares[:, 0] == n, 1:].tolist()]
        name = name_of(plan)
        if name in kept:
            summed[n] = name
        else:
            lacking[n] = plan
    if lacking:
        with archive.open(entry) as file:
            yield from zip(
                lacking, films.means(decoder, file, entry, [*lacking.values()], *size), strict=True
            )
    for n, name in summed.items():
        with uploads.read_sum(objects, capture, name) as total:
            yield n, films.mean_of_sum(decoder, total, entry, *size)


def _size(pixels: NDArray[np.generic]) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]}"
