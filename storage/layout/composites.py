"""Composites of clips in the store: ``composites/JOB/``, named by the id of the job.

- ``clip``: the uploaded clip;
- ``ticks``: the time of each of its frames, int64 little-endian, in ticks of its time base;
- ``segments/N``: the frames of tile N, composited and encoded;
- ``video.mp4``: the result. Once it is stored, the others are removed.
"""

from storage.objects.store import Objects

VIDEO = "video.mp4"


def path(job: str) -> str:
    """Path of everything that belongs to a composite."""
    return f"composites/{job}"


def clip_path(job: str) -> str:
    """Path of the clip."""
    return f"{path(job)}/clip"


def ticks_path(job: str) -> str:
    """Path of the times of the clip's frames."""
    return f"{path(job)}/ticks"


def segment_path(job: str, tile: int) -> str:
    """Path of a tile."""
    return f"{path(job)}/segments/{tile}"


def video_path(job: str) -> str:
    """Path of the result."""
    return f"{path(job)}/{VIDEO}"


def missing(objects: Objects, job: str, tiles: int) -> list[int]:
    """The tiles that are not stored, ascending."""
    stored = set(objects.names(f"{path(job)}/segments"))
    return [tile for tile in range(tiles) if str(tile) not in stored]


def remove_inputs(objects: Objects, job: str) -> None:
    """Remove the clip, its times and the segments."""
    for what in (clip_path(job), ticks_path(job), f"{path(job)}/segments"):
        objects.delete(what)
