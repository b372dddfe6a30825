"""Edges of blocks bound the number of objects."""

import pytest

from storage.layout.blocks import EDGES, LARGEST, block_edge


@pytest.mark.parametrize(
    ("height", "width", "edge"),
    [
        (1, 1, 16),
        (128, 128, 16),  # 8 x 8 blocks of 16 are just 64
        (129, 128, 32),
        (120, 160, 32),
        (480, 640, 32),
        (1024, 1024, 32),
        (1080, 1920, 64),
        (16384, 16384, 64),
    ],
)
def test_edge_of_known_frames(height: int, width: int, edge: int) -> None:
    assert block_edge(height, width) == block_edge(width, height) == edge


def test_edge_is_smallest_that_bounds_number_of_blocks() -> None:
    for height in range(1, 5000, 331):
        for width in range(1, 5000, 297):
            edge = block_edge(height, width)
            fits = [e for e, most in EDGES.items() if -(-height // e) * -(-width // e) <= most]
            assert edge == min(fits, default=LARGEST)
