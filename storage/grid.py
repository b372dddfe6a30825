"""How a frame is laid out in blocks: the pieces that captures and mattes are stored in."""

BLOCKS = 2048
"""About the most blocks that a frame is cut into, while a block is no larger than 128 pixels."""


def block_edge(height: int, width: int) -> int:
    """The edge of a frame's blocks, in pixels: a power of two from 16 to 128.

    It depends on the frame's size alone, so what is stored is the same however work was cut into tiles; it
    grows with the frame so that the number of objects in the store stays bounded, and a block's recovery
    takes seconds.
    """
    edge = 16
    while edge < 128 and -(-height // edge) * -(-width // edge) > BLOCKS:
        edge *= 2
    return edge
