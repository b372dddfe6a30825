"""What an owner may have, and what the service holds: looked at before anything is taken."""

from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection

from services.settings import Settings
from storage.errors import NoRoom, TooMany
from storage.objects.store import Objects
from storage.records import statistics, uploads

Unit = Literal["bytes", "frames", "pixels", "captures", "jobs", "seconds"]


@dataclass(frozen=True)
class Limit:
    """A limit: the setting of its name says how much; None sets none.

    Attributes
    ----------
    used : int, optional
        What of it is used, if it is one of all together.
    """

    name: str
    unit: Unit
    limit: int | None
    used: int | None
    description: str


UNITS: dict[str, Unit] = {
    "upload_bytes": "bytes",
    "unpacked_bytes": "bytes",
    "capture_frames": "frames",
    "capture_pixels": "pixels",
    "backdrop_bytes": "bytes",
    "owner_captures": "captures",
    "owner_jobs": "jobs",
    "owner_bytes": "bytes",
    "store_bytes": "bytes",
    "upload_seconds": "seconds",
    "capture_seconds": "seconds",
    "matte_seconds": "seconds",
    "job_seconds": "seconds",
}
"""The settings that are limits."""


def limits_of(connection: Connection, settings: Settings, *, whole: bool) -> list[Limit]:
    """Every limit, and what the owner that a connection is bound to has used of it.

    Parameters
    ----------
    whole : bool
        Whether to tell what all owners have used together.
    """
    used = {
        "owner_captures": statistics.captures_and_uploads(connection),
        "owner_jobs": statistics.active_jobs(connection),
        "owner_bytes": statistics.stored_bytes(connection),
    }
    if whole:
        used["store_bytes"] = statistics.stored_bytes(connection, all_owners=True)
    return [
        Limit(
            name, unit, getattr(settings, name), used.get(name), str(Settings.model_fields[name].description)
        )
        for name, unit in UNITS.items()
    ]


def admit(
    connection: Connection, settings: Settings, *, captures: int = 0, jobs: int = 0, size: int = 0
) -> None:
    """See that an owner may have so much more; in the transaction that writes it down it holds for certain.

    Parameters
    ----------
    size : int
        Bytes; 0 still asks that the limits are not passed yet.

    Raises
    ------
    NoRoom
        Where something has to be deleted first.
    TooMany
        Where some time does.
    """
    if captures and settings.owner_captures is not None:
        value = statistics.captures_and_uploads(connection) + captures
        if value > settings.owner_captures:
            raise NoRoom(
                f"you may have {settings.owner_captures} captures, uploads under way among them, and this would be the "
                f"{value}th; delete some first",
                name="owner_captures",
                limit=settings.owner_captures,
                value=value,
            )
    if jobs and settings.owner_jobs is not None:
        value = statistics.active_jobs(connection) + jobs
        if value > settings.owner_jobs:
            raise TooMany(
                f"you may have {settings.owner_jobs} jobs that are queued or running, ingests among them, and this "
                f"would be the {value}th; wait for one, or cancel one",
                name="owner_jobs",
                limit=settings.owner_jobs,
                value=value,
            )
    for name, most, whose in (
        ("owner_bytes", settings.owner_bytes, "you may have"),
        ("store_bytes", settings.store_bytes, "this service may have"),
    ):
        if most is None:
            continue
        value = statistics.stored_bytes(connection, all_owners=name == "store_bytes") + size
        if value > most:
            # Of the whole service only what is missing: the rest is other owners' business.
            raise NoRoom(
                f"{whose} {most} bytes stored, and {value - most} more than that would be; delete captures, mattes, "
                "videos, uploads or programs first",
                name=name,
                limit=most,
                value=value if name == "owner_bytes" else size,
                missing=value - most,
            )


def admit_upload(
    connection: Connection,
    settings: Settings,
    objects: Objects,
    size: int,
    *,
    captures: int = 0,
    jobs: int = 0,
) -> None:
    """The same of something that is to be sent, before it is: with that the disk has room for its bytes.

    Raises
    ------
    NoRoom, TooMany
    """
    admit(connection, settings, captures=captures, jobs=jobs, size=size)
    uploads.check_room(connection, objects, size)
