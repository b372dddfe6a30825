"""How a frame is laid out in blocks: the pieces that captures and mattes are stored in."""

EDGES = {16: 64, 32: 1024}
"""Edges of blocks, and the most blocks of each that a frame is cut into."""
LARGEST = 64
"""Edge of the largest block: its 4,096 pixels take a worker some seconds."""


def block_edge(height: int, width: int) -> int:
    """The edge of a frame's blocks, in pixels: 16, 32 or 64.

    It depends on the frame's size alone, so what is stored is the same however work was cut into tiles. It
    grows with the frame: a block is a handful of objects in the store, and a task of its own unless a job
    asks for larger tiles. Blocks of 16 are for frames so small that there would be too few tasks; their 256 pixels
    take hardly longer than their reading and writing.
    """
    for edge, most in EDGES.items():
        if -(-height // edge) * -(-width // edge) <= most:
            return edge
    return LARGEST
