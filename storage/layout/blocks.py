"""Size of the blocks that the frames of captures and mattes are stored in."""

EDGES = {16: 64, 32: 1024}
"""Edge of a block in pixels: the most blocks of this size that a frame is cut into."""
LARGEST = 64
"""Edge of the largest block: recovering its 4,096 pixels takes a worker some seconds."""


def block_edge(height: int, width: int) -> int:
    """The edge of a frame's blocks, in pixels: 16, 32 or 64.

    The edge depends only on the size of the frame, so the stored bytes do not depend on the tiles of a job. It grows
    with the frame, because a block takes several objects in the store, and one task unless a job asks for larger
    tiles. Blocks of 16 pixels are for frames so small that there would be too few tasks; recovering their 256 pixels
    takes little longer than reading and writing them.
    """
    for edge, most in EDGES.items():
        if -(-height // edge) * -(-width // edge) <= most:
            return edge
    return LARGEST
