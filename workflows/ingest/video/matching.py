"""The frames of a video sorted by the patterns that they show, and what to make of those that are not found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.ingest.video import border_reader, lead_in
from workflows.ingest.video import resemblance as likeness
from workflows.ingest.video.border_spill import without_border
from workflows.ingest.video.decoder import PARTS, Large, Share, Signatures
from workflows.ingest.video.missing_patterns import Reason, by_reason, ranges
from workflows.ingest.video.recording import Recording
from workflows.ingest.video.timing import Edge, Found, find
from workflows.programs.border import Border
from workflows.programs.program import Program

Doubles = NDArray[np.float64]

MOST_PATTERNS = 2000
"""Of a program that is filmed: sorting takes memory in proportion to their square."""
LEAST_SHARE = 0.6
"""Of the patterns that are not constant: with fewer, a recording is refused."""
LEAST_RESEMBLANCE = 2.5
"""Standard deviations, see `content.resemblance`."""
EDGES: tuple[tuple[tuple[Edge, Edge], ...], ...] = (
    (("seen", "seen"), ("hidden", "seen"), ("seen", "hidden"), ("hidden", "hidden")),
    (("seen", "cut"), ("cut", "seen"), ("hidden", "cut"), ("cut", "hidden")),
)
"""How the program may begin and end: what is more likely comes first."""
_AS_LIKELY = 10.0  # difference of the -ln likelihoods of the timing
_EVENTS = 2  # for each pattern
_RESTLESS = 5.0  # codes
_GAMMA = 2.2  # near enough to any camera's curve to compare what it saw


@dataclass(frozen=True)
class Sorted:
    """A recording, sorted.

    Attributes
    ----------
    shares : dict of int to tuple of Share
        The frames of each pattern that was found.
    record : dict
        What was found, as JSON: ``tick`` in seconds, ``frames`` that were decoded, ``kept``, ``numbered``: whether
        patterns are told by the numbers in the border, ``first_pattern_seconds``, ``patterns_per_second``,
        ``resemblance``, and ``missing``: the number of each pattern without frames, and why.
    notes : list of str
        The same for people.
    """

    shares: dict[int, tuple[Share, ...]]
    record: dict[str, Any]
    notes: list[str]

    @property
    def table(self) -> NDArray[np.int64]:
        """(k, 3) int64: the shares of the patterns in order, each with the pattern's place among those found."""
        rows = [(n, *share) for n, shares in enumerate(self.shares.values()) for share in shares]
        return np.array(rows, np.int64)


def sort(
    signatures: Signatures,
    ticks: NDArray[np.int64],
    tick: float,
    program: Program,
    light: likeness.Light,
    rate: float,
    entry: str,
    large: Large,
    border: Border | None,
) -> Sorted:
    """Sort the frames of a recording by the patterns of a program.

    Parameters
    ----------
    signatures : (frames, rows, columns, 3) uint8
    ticks : (frames,) int64
        When each frame is shown.
    tick : float
        Seconds of a tick.
    program : Program
    light : (patterns, rows, columns, 3) float32
        Of its patterns, see `content.lay_out`.
    rate : float
        Patterns a second, about.
    entry : str
        The video's name, for errors.
    large : Large
        Some of the frames at a size that shows the cells of a border; of no use without one.
    border : Border or None
        What the patterns were shown in, between a lead-in and a lead-out, see `workflows.programs.border.schedule`.

    Raises
    ------
    CaptureError
        If too little of the program is found.
    """

    def refused(what: str) -> CaptureError:
        return CaptureError(f"{entry}: {what}", entry=entry)

    recording = Recording(signatures, (ticks - ticks[0]) * tick, 1 / rate)
    found = border_reader.find(recording, large, border, program.count) if border is not None else None
    numbered = found is not None
    if found is None:
        found = _by_timing(recording, rate, program, light, border is not None, refused)
    looks, resemblance, odd = _compared(recording, found, program, light, border is not None)
    reasons = dict(found.reasons)
    for number in odd:
        reasons[number] = Reason.ODD
        del looks[number]
    wrong = np.isin(program.constants[0], odd).mean() > 0.5
    if wrong or (resemblance is not None and resemblance < LEAST_RESEMBLANCE):
        raise refused(
            "what changes in the video does not look like the patterns of the program: see that capture.json has the "
            "program that was shown, and its patterns_per_second"
        )
    _see_that_it_is_enough(program, looks, reasons, rate, refused)
    kept = sorted(looks)
    shares = {number: _shares(ticks[found.frames[number]], found.weights[number]) for number in kept}
    record = {
        "tick": tick,
        "frames": len(ticks),
        "kept": sum(len(share) for share in shares.values()),
        "numbered": numbered,
        "first_pattern_seconds": round(found.start, 3),
        "patterns_per_second": round(found.rate, 4),
        "resemblance": None if resemblance is None else round(resemblance, 1),
        "missing": {str(number): reason for number, reason in sorted(reasons.items())},
    }
    notes = [_summary(record, len(kept), program.count), *_by_reason(reasons)]
    if border is not None and not numbered:
        notes.append("the numbers in the border can't be read: patterns are told by the times of the changes")
    return Sorted(shares, record, notes)


def _by_timing(
    recording: Recording, rate: float, program: Program, light: likeness.Light, has_lead: bool, refused: Any
) -> Found:
    """The frames of each pattern by when the picture changes."""
    frames, begins, ends = slice(0, len(recording.times)), False, False
    if has_lead:
        frames, first, ends = lead_in.find(recording)
        recording = Recording(recording.signatures[frames], recording.times[frames], 1 / rate)
        begins = first is not None
        if first is not None:
            lead_in.with_begin(recording, first)
    if not recording.events and recording.noise.max(initial=0) > _RESTLESS:
        raise refused(
            "the picture changes from each frame to the next and never stands still: record more frames a second, show "
            "fewer patterns, and keep the camera at rest"
        )
    if not recording.events:
        raise refused("nothing changes in the video: film the monitor while it shows the program")
    if len(recording.events) > _EVENTS * program.count + 100:
        raise refused(
            f"the picture changes {len(recording.events)} times, but the program has {program.count} patterns: keep "
            "the camera, the light and the glass at rest, and cut off what does not belong to the program"
        )
    found = _best(recording, rate, program, light, has_lead, begins, ends, refused)
    start = found.start + float(recording.times[0])
    return replace(found, frames=[some + frames.start for some in found.frames], start=start)


def _best(
    recording: Recording,
    rate: float,
    program: Program,
    light: likeness.Light,
    has_border: bool,
    begins: bool,
    ends: bool,
    refused: Any,
) -> Found:
    """What fits the timing, and of that what looks most like the program.

    The whole program; or if that can't be, a part of it: all but its end, or its beginning. Where a lead-in or a
    lead-out was found, it `begins` or `ends` with the first or the last event.
    """
    flat = light.reshape(len(light), -1)
    same = (flat[1:] == flat[:-1]).all(axis=1)
    for edges in EDGES:
        tried = [
            find(recording, rate, same, begin, end)
            for begin, end in edges
            if (begin == "seen" or not begins) and (end == "seen" or not ends)
        ]
        fitting = [found for found in tried if found is not None and not found.jumps]
        if fitting:
            break
    else:
        raise refused(
            f"the {len(recording.events)} changes in the video do not fit {program.count} patterns at {rate:g} a "
            "second: see that capture.json has the program that was shown and its patterns_per_second, and record "
            "all of it in one go, with everything at rest"
        )
    least = min(found.cost for found in fitting)
    likely = [found for found in fitting if found.cost <= least + _AS_LIKELY]

    def score(found: Found) -> float:
        _, resemblance, odd = _compared(recording, found, program, light, has_border)
        return (resemblance or 0.0) - len(odd)

    return likely[0] if len(likely) == 1 else max(sorted(likely, key=lambda found: found.cost), key=score)


def _compared(
    recording: Recording, found: Found, program: Program, light: likeness.Light, has_border: bool
) -> tuple[dict[int, Doubles], float | None, list[int]]:
    """What was seen of each pattern, about in linear light; its resemblance to the program; the odd ones."""
    looks = {n: (recording.look(f) / 255) ** _GAMMA for n, f in enumerate(found.frames) if f.size}
    if has_border:
        looks = without_border(program, looks)
    return looks, likeness.resemblance(program, light, looks), likeness.odd(program, light, looks)


def _see_that_it_is_enough(
    program: Program, looks: Mapping[int, Doubles], reasons: Mapping[int, Reason], rate: float, refused: Any
) -> None:
    numbers, sent = program.constants
    there = np.isin(numbers, list(looks))
    why = "; ".join(_by_reason(reasons))
    if not there.any() or (np.ptp(sent[there], axis=0) < np.ptp(sent, axis=0) / 2).any():
        raise refused(f"the dark and bright constant patterns are not both found: {why}. Record it again")
    share = float(np.isin(program.measured, list(looks)).mean())
    if share < LEAST_SHARE:
        raise refused(
            f"only {share:.0%} of the patterns are found: {why}. Record it again, at more frames a second, or show "
            f"fewer than {rate:g} patterns a second"
        )


def _shares(ticks: NDArray[np.int64], weights: Doubles) -> tuple[Share, ...]:
    """Weights as whole parts of `PARTS`, by largest remainders."""
    exact = PARTS * weights / weights.sum()
    parts = np.floor(exact).astype(int)
    parts[np.argsort(parts - exact, kind="stable")[: PARTS - parts.sum()]] += 1
    return tuple(Share(int(tick), int(part)) for tick, part in zip(ticks, parts, strict=True) if part)


def _summary(record: Mapping[str, Any], kept: int, count: int) -> str:
    return (
        f"{record['frames']} frames: {kept} of {count} patterns found, {record['kept']} frames kept; the first pattern "
        f"begins at {record['first_pattern_seconds']} s, {record['patterns_per_second']} a second"
    )


def _by_reason(reasons: Mapping[int, Reason]) -> list[str]:
    """A line a reason: the patterns that it holds for, as ranges."""
    return [
        f"no frame of pattern{'s' * (len(numbers) > 1)} {ranges(numbers)}: {reason}"
        for numbers, reason in by_reason(reasons)
    ]
