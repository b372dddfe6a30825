"""Edges of blocks: powers of two that keep the number of objects bounded."""

import pytest

from storage.grid import BLOCKS, LARGEST, block_edge


@pytest.mark.parametrize(
    ("height", "width", "edge"),
    [
        (1, 1, 16),
        (120, 160, 16),
        (512, 512, 16),  # 32 x 32 blocks of 16 are just 1024
        (513, 512, 32),
        (480, 640, 32),
        (1080, 1920, 64),
        (16384, 16384, 64),
    ],
)
def test_edges_of_known_frames(height: int, width: int, edge: int) -> None:
    assert block_edge(height, width) == block_edge(width, height) == edge


def test_an_edge_is_the_smallest_that_bounds_the_blocks() -> None:
    for height in range(1, 5000, 331):
        for width in range(1, 5000, 297):
            edge = block_edge(height, width)
            blocks = [-(-height // e) * -(-width // e) for e in (edge // 2, edge)]
            assert edge in (16, 32, LARGEST)
            assert blocks[1] <= BLOCKS or edge == LARGEST
            assert blocks[0] > BLOCKS or edge == 16
