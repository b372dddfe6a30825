"""How a frame is laid out in blocks: the pieces that captures and mattes are stored in."""

BLOCKS = 1024
"""The most blocks that a frame is cut into, while a block is smaller than `LARGEST`."""
LARGEST = 64
"""Edge of the largest block: its 4,096 pixels take a worker some seconds."""


def block_edge(height: int, width: int) -> int:
    """The edge of a frame's blocks, in pixels: 16, 32 or 64.

    It depends on the frame's size alone, so what is stored is the same however work was cut into tiles. It
    grows with the frame: a block is a handful of objects in the store, and a task of its own unless a job
    asks for larger tiles.
    """
    edge = 16
    while edge < LARGEST and -(-height // edge) * -(-width // edge) > BLOCKS:
        edge *= 2
    return edge
