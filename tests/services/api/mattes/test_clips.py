"""Ranges of a video: every Range header has an answer."""

import pytest

from services.api.mattes.composites.clips import _span


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("bytes=2-4", (2, 5)),
        ("bytes=2-", (2, 10)),
        ("bytes=-3", (7, 10)),
        ("bytes=-0", (10, 10)),
        ("bytes=20-", (20, 10)),
        (f"bytes={10**18 - 1}-", (10**18 - 1, 10)),
        (f"bytes={'9' * 5000}-", (0, 10)),  # more digits than Python converts to an int
        (f"bytes=-{'9' * 5000}", (0, 10)),
        (f"bytes=0-{'9' * 5000}", (0, 10)),
        ("bytes=0-1,3-4", (0, 10)),
        ("bytes=-", (0, 10)),
    ],
)
def test_range_is_parsed(text: str, span: tuple[int, int]) -> None:
    assert _span(text, 10) == span
