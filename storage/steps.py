"""The steps of a job besides its tiles: prepare and finish."""

PREPARE, FINISH = -2, -1
"""Numbers of the steps before and after a job's tiles. They are recorded like tiles, but have no pixels."""


def step_name(tile: int) -> str:
    """Name of a tile, or of the step before or after them, for people."""
    return {PREPARE: "preparing", FINISH: "finishing"}.get(tile, f"tile {tile}")
