"""Read the film of a capture, or a clip, in a decoder."""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Annotated, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from workflows.images import hdr
from workflows.ingest.plateau_sums import PlateauSums, from_bytes, name_of, to_bytes
from workflows.ingest.video.clip import Clip, open_clip
from workflows.ingest.video.frame_means import Share, mean_frames, mean_of
from workflows.ingest.video.signatures import CELLS, LARGE_CELLS, LargeFrames, Signatures, SmallCopies
from workflows.untrusted.decoder import Decoder, blaming

Positive = Annotated[int, Field(ge=1)]
THREADS = 4
"""Threads that decode a film from its first frame to its last, when no other worker can help: with two, a core of two
waits while small copies are made, and a film of 76 s in full HD takes 13.1 s rather than 11.6."""

WAITING = 2
"""Pictures of the largest size that may wait until their plateau has ended: 80 frames of full HD."""
_SHARES = TypeAdapter(list[Share])


class Film(BaseModel):
    """What is known of a film once all of it has been read; see `workflows.ingest.video.clip.Clip`.

    Attributes
    ----------
    width, height : int
        Upright.
    numerator, denominator : int
        Length of a tick in seconds.
    stated_duration : float
        In seconds; 0 if none is stated.
    interlaced : bool
    transfer : int
        Transfer characteristics of its first frame (ITU-T H.273, table 3).
    lost : list of int
        The first and the last time, in ticks, of the frames that could not be decoded; empty if all could be.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    width: Positive
    height: Positive
    numerator: Positive
    denominator: Positive
    stated_duration: Annotated[float, Field(ge=0)]
    interlaced: bool
    transfer: Annotated[int, Field(ge=0, le=255)]
    lost: Annotated[list[int], Field(max_length=2)]

    @property
    def time_base(self) -> Fraction:
        """Length of a tick in seconds, exactly."""
        return Fraction(self.numerator, self.denominator)


class KeepSums(NamedTuple):
    """Where the sums of plateaus are kept, see `workflows.ingest.plateau_sums`.

    Attributes
    ----------
    hold : float
        About how long a pattern is shown, in seconds.
    most : int
        How many sums are kept, at most.
    put : callable
        Keeps a sum by its name.
    """

    hold: float
    most: int
    put: Callable[[str, memoryview], None]


def scan(
    decoder: Decoder,
    file: BinaryIO,
    entry: str,
    max_bytes: int,
    every: float | None,
    keep: KeepSums | None = None,
) -> tuple[Film, Signatures, NDArray[np.int64], LargeFrames]:
    """Read all of a film, for `workflows.ingest.video.matching`.

    Parameters
    ----------
    max_bytes : int
        Bytes that the signatures and large frames may take.
    every : float, optional
        Seconds between large frames; None for none.
    keep : KeepSums, optional
        Where to keep the sums of plateaus.

    Returns
    -------
    film : Film
    signatures, ticks, large
        As of `workflows.ingest.video.signatures.SmallCopies`.

    Raises
    ------
    CaptureError
        If it can't be read, or has more frames than fit.
    """
    with blaming(entry, decoder):
        answers = decoder.run(
            _scan,
            file,
            entry=entry,
            memory=decoder.image_bytes,
            max_bytes=max_bytes,
            every=every,
            hold=keep and keep.hold,
        )
        with decoder.checking():
            found, signatures, ticks, grey, frames = answers if keep is None else _without_sums(answers, keep)
            film = Film.model_validate(found)
            _require_grid(signatures, len(ticks), CELLS, 4)
            _require_grid(grey, len(frames), LARGE_CELLS, 3)
            _require_ascending(ticks)
            if len(frames):
                _require_ascending(frames)
                if not 0 <= frames[0] <= frames[-1] < len(ticks):
                    raise ValueError("a large frame is none of the film")
            return film, signatures, ticks, LargeFrames(grey, frames.astype(np.intp))


def _without_sums(answers: Iterator[Any], keep: KeepSums) -> Iterator[Any]:
    """What a decoder answers beside the sums, which are kept."""
    kept = 0
    for answer in answers:
        if not isinstance(answer, dict) or "shares" not in answer:
            yield answer
            continue
        shares, total = _SHARES.validate_python(answer["shares"]), next(answers, None)
        kept += 1
        if not isinstance(total, np.ndarray) or total.ndim != 1 or kept > keep.most:
            raise ValueError("a sum is missing, or there are too many")
        # What is in it is looked at by no one but another decoder.
        keep.put(name_of(shares), total.data)


def times(
    decoder: Decoder, file: BinaryIO, entry: str, max_frames: int
) -> tuple[Film, NDArray[np.int64], int]:
    """Read all of a film, to know when its frames are shown.

    Returns
    -------
    film : Film
    ticks, last
        As of `workflows.ingest.video.clip.Clip.ticks`.

    Raises
    ------
    CaptureError
        If it can't be read, or has more than ``max_frames``.
    """
    with blaming(entry, decoder):
        answers = decoder.run(_times, file, entry=entry, memory=decoder.image_bytes, max_frames=max_frames)
        with decoder.checking():
            found, ticks, last = answers
            _require_ascending(ticks)
            if last.shape != (1,) or last[0] < 0 or len(ticks) > max_frames:
                raise ValueError("the times of the frames are wrong")
            return Film.model_validate(found), ticks, int(last[0])


def full_scale(film: Film, shown: Signatures) -> float:
    """The light that frames of a film are to have at full scale, see `workflows.images.hdr.full_scale`.

    Parameters
    ----------
    film : Film
    shown : (frames, rows, columns, 3) uint8
        The signatures of frames of the patterns.
    """
    if not hdr.is_hdr(film.transfer):
        return 1.0
    light = hdr.light_of_hdr(film.transfer)
    brightest, darkest = (
        light[codes.astype(np.intp) * 257] for codes in (shown.max(axis=0), shown.min(axis=0))
    )
    return hdr.full_scale(film.transfer, brightest, darkest)


def means(
    decoder: Decoder,
    file: BinaryIO,
    entry: str,
    plan: Sequence[Sequence[Share]],
    width: int,
    height: int,
    full: float = 1.0,
) -> Iterator[NDArray[np.uint16]]:
    """Weighted means of frames, see `workflows.ingest.video.frame_means.mean_frames`.

    Parameters
    ----------
    width, height : int
        Size of the frames, upright.
    full : float
        The light of HDR that becomes full scale.

    Raises
    ------
    CaptureError
        If a frame can't be decoded again.
    """
    with blaming(entry, decoder):
        answers = decoder.run(_means, file, entry=entry, memory=decoder.image_bytes, plan=plan, full=full)
        yield from _pictures(decoder, answers, len(plan), (height, width))


def mean_of_sum(
    decoder: Decoder, total: BinaryIO, entry: str, width: int, height: int, full: float
) -> NDArray[np.uint16]:
    """The mean that `means` would yield, of a sum that `KeepSums` was given."""
    with blaming(entry, decoder):
        answers = decoder.run(_mean_of_sum, total, whole=True, full=full)
        (mean,) = _pictures(decoder, answers, 1, (height, width))
    return mean


def _pictures(
    decoder: Decoder, answers: Iterator[Any], count: int, size: tuple[int, int]
) -> Iterator[NDArray[np.uint16]]:
    """The means that a decoder answers."""
    for _ in range(count):
        with decoder.checking():
            mean = next(answers, None)
            if not isinstance(mean, np.ndarray) or mean.dtype != np.uint16 or mean.shape != (*size, 3):
                raise ValueError("a mean is missing, or has another size")
        yield mean
    with decoder.checking():
        () = answers


def _require_grid(values: Any, count: int, most: tuple[int, int], dimensions: int) -> None:
    """Check small copies of frames: so many, with at most so many columns and rows."""
    if not isinstance(values, np.ndarray) or values.dtype != np.uint8 or values.ndim != dimensions:
        raise ValueError("small copies of frames are of the wrong kind")
    number, rows, columns, *channels = values.shape
    if number != count or columns > most[0] or rows > most[1] or channels not in ([], [3]):
        raise ValueError("small copies of frames are of the wrong size")


def _require_ascending(values: Any) -> None:
    if not isinstance(values, np.ndarray) or values.dtype != np.int64 or values.ndim != 1:
        raise ValueError("these are no times or indices")
    if not len(values) or (values[1:] <= values[:-1]).any():
        raise ValueError("times or indices do not ascend")


# What follows runs in a decoder.


def _scan(
    file: BinaryIO, entry: str, memory: int, max_bytes: int, every: float | None, hold: float | None
) -> Iterator[dict[str, Any] | NDArray[Any]]:
    with open_clip(file, entry, memory, THREADS) as clip:
        copies = SmallCopies(clip, max_bytes, np.inf if every is None else every)
        sums = None if hold is None else PlateauSums(clip, hold, WAITING * memory)
        for frame in clip.frames():
            signature = copies.add(frame)
            for shares, total in sums.add(frame, signature) if sums else ():
                packed = to_bytes(total)
                if packed.nbytes <= memory:
                    yield {"shares": shares}
                    yield packed
        signatures, ticks, large = copies.taken()
        yield _film(clip, ticks)
    yield signatures
    yield ticks
    yield large.grey
    yield large.frames.astype(np.int64)


def _times(
    file: BinaryIO, entry: str, memory: int, max_frames: int
) -> Iterator[dict[str, Any] | NDArray[Any]]:
    with open_clip(file, entry, memory, THREADS) as clip:
        ticks, last = clip.ticks(max_frames)
        yield _film(clip, ticks)
    yield ticks
    yield np.array([last], np.int64)


def _means(
    file: BinaryIO, entry: str, memory: int, plan: list[list[list[int]]], full: float
) -> Iterator[NDArray[np.uint16]]:
    with open_clip(file, entry, memory) as clip:
        yield from mean_frames(clip, [[Share(*share) for share in shares] for shares in plan], full)


def _mean_of_sum(file: BinaryIO, full: float) -> Iterator[NDArray[np.uint16]]:
    yield mean_of(from_bytes(file), full)


def _film(clip: Clip, ticks: NDArray[np.int64]) -> dict[str, Any]:
    lost = sorted({at for at in clip.lost if at >= ticks[0]} - set(ticks.tolist()))
    return {
        "width": clip.width,
        "height": clip.height,
        "numerator": clip.time_base.numerator,
        "denominator": clip.time_base.denominator,
        "stated_duration": max(clip.stated_duration, 0.0),
        "interlaced": clip.interlaced,
        "transfer": clip.transfer,
        "lost": [lost[0], lost[-1]] if lost else [],
    }
