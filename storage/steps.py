"""The steps of a job that are not tiles."""

PREPARE, FINISH = -2, -1
"""The steps before and after a job's tiles: tiles too, of which nobody counts the pixels."""


def step_name(tile: int) -> str:
    """What people call a tile, or a step around them."""
    return {PREPARE: "preparing", FINISH: "finishing"}.get(tile, f"tile {tile}")
