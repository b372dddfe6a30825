"""Composites of clips in the store, each in ``composites/JOB/`` under the id of the job that makes it.

- ``clip``: the clip, as it was uploaded;
- ``ticks``: when each of its frames is shown, int64 little-endian, in ticks of its clock;
- ``segments/N``: the frames of tile N, composited and encoded;
- ``video.mp4``: what came of it. Once it is there the others go.
"""

from storage.objects.store import Objects

VIDEO = "video.mp4"


def path(job: str) -> str:
    """Where all of it lies."""
    return f"composites/{job}"


def clip_path(job: str) -> str:
    """Where the clip lies."""
    return f"{path(job)}/clip"


def ticks_path(job: str) -> str:
    """Where its frames' times lie."""
    return f"{path(job)}/ticks"


def segment_path(job: str, tile: int) -> str:
    """Where a tile lies."""
    return f"{path(job)}/segments/{tile}"


def video_path(job: str) -> str:
    """Where the video lies."""
    return f"{path(job)}/{VIDEO}"


def missing(objects: Objects, job: str, tiles: int) -> list[int]:
    """The tiles that are not there, ascending."""
    stored = set(objects.names(f"{path(job)}/segments"))
    return [tile for tile in range(tiles) if str(tile) not in stored]


def remove_inputs(objects: Objects, job: str) -> None:
    """Remove what the video was made of."""
    for what in (clip_path(job), ticks_path(job), f"{path(job)}/segments"):
        objects.delete(what)
