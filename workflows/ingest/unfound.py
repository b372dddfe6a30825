"""Patterns of which a recording has no frame that can be used: in words, and what to do about them."""

from collections.abc import Iterable, Mapping
from itertools import chain, groupby

_LONGER = "record more frames a second, or show each pattern for longer"
_AT_REST = "keep hands and other light away, and camera, glass and monitor at rest"
REMEDIES = {
    "the recording begins after it": "start the recording before the program",
    "the recording ends before it": "let the recording go on until after the program",
    "no two frames show it whole": _LONGER,
    "no two frames of it are alike: it was too short, or something moved": f"{_LONGER}; {_AT_REST}",
    "the changes before and after it can't be told from others, or did not show": _AT_REST,
    "no frames that stand still show its number in the border": f"{_LONGER}; {_AT_REST}",
    "something changed while it was shown": _AT_REST,
    "it looks unlike others of its kind, as if something had been in front": _AT_REST,
}
"""What to do, by the reasons that sorting gives."""


def by_reason(reasons: Mapping[int, str]) -> list[tuple[list[int], str]]:
    """Numbers of patterns, in order, that have a reason in common, and the reason."""
    ordered = sorted(reasons.items(), key=lambda item: (item[1], item[0]))
    return [([n for n, _ in items], reason) for reason, items in groupby(ordered, key=lambda item: item[1])]


def ranges(numbers: Iterable[int]) -> str:
    """Numbers in order, in words.

    Examples
    --------
    >>> ranges([1, 4, 5, 6])
    '1, 4 to 6'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in runs)


def remedy(reasons: Iterable[str]) -> str:
    """What to do about patterns that have no frame for these reasons."""
    known = [REMEDIES.get(reason, _LONGER).split("; ") for reason in sorted(reasons)]
    return "film again: " + "; ".join(dict.fromkeys(chain(*known)))
