"""Segments that are not those of one video: joined, they would play wrongly or not at all."""

import io
from fractions import Fraction

import numpy as np
import pytest

from storage.errors import Corrupt
from tests.workflows.composite.video.test_steps import pictures
from workflows.composite.video.segments import encode, join

FRAMES = 3


@pytest.mark.parametrize(
    ("width", "frames", "why"),
    [
        (72, 2 * FRAMES + 1, "too few frames"),
        (72, 2 * FRAMES - 1, "too many frames"),
        (80, 2 * FRAMES, "do not fit together"),
    ],
)
def test_segments_of_another_video_are_refused(width: int, frames: int, why: str) -> None:
    found = [encode(pictures(FRAMES, width=wide), 30, 16, "srgb") for wide in (72, width)]
    with pytest.raises(Corrupt, match=why):
        join(found, 20 * np.arange(frames), 20, Fraction(1, 600), io.BytesIO())
