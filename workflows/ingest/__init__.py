"""From a capture archive to a stack of frames, and a report on them."""
