"""Patterns that are missing from a recording: why, and what to do about it."""

from collections import Counter
from collections.abc import Iterable, Mapping
from enum import StrEnum
from itertools import chain, groupby

_LONGER = "record more frames a second, or show each pattern for longer"
_AT_REST = "keep hands and other light away, and camera, glass and monitor at rest"


class Reason(StrEnum):
    """Why a pattern has no frames."""

    BEFORE = "the recording begins after it"
    AFTER = "the recording ends before it"
    TORN = "no two frames show it whole"
    SHORT = "no two frames of it are alike: it was too short, or something moved"
    UNCLEAR = "the changes before and after it are not visible, or not distinct from others"
    UNNUMBERED = "no frames that stand still show its number in the border"
    DISTURBED = "something changed while it was shown"
    ODD = "it looks unlike others of its kind, as if something had been in front"


REMEDIES: dict[str, str] = {
    Reason.BEFORE: "start the recording before the program",
    Reason.AFTER: "let the recording go on until after the program",
    Reason.TORN: _LONGER,
    Reason.SHORT: f"{_LONGER}; {_AT_REST}",
    Reason.UNCLEAR: _AT_REST,
    Reason.UNNUMBERED: f"{_LONGER}; {_AT_REST}",
    Reason.DISTURBED: _AT_REST,
    Reason.ODD: _AT_REST,
}


def by_reason(reasons: Mapping[int, str]) -> list[tuple[list[int], str]]:
    """Group the numbers of patterns by reason: ascending numbers, and the reason that they share."""
    ordered = sorted(reasons.items(), key=lambda item: (item[1], item[0]))
    return [([n for n, _ in items], reason) for reason, items in groupby(ordered, key=lambda item: item[1])]


def ranges(numbers: Iterable[int]) -> str:
    """Ascending numbers in words, runs as ranges.

    Examples
    --------
    >>> ranges([1, 4, 5, 6])
    '1, 4-6'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def remedy(reasons: Iterable[str]) -> str:
    """What to do about patterns that are missing for these reasons, the most frequent first."""
    frequent = Counter(sorted(reasons)).most_common()
    known = [REMEDIES.get(reason, _LONGER).split("; ") for reason, _ in frequent]
    return "film again: " + "; ".join(dict.fromkeys(chain(*known)))
