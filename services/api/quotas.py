"""Limits of owners and of the whole service, checked before anything is accepted."""

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
    """A limit, from the setting of the same name.

    Attributes
    ----------
    limit : int, optional
        None if there is none.
    used : int, optional
        How much is in use, if the limit is for all items together.
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
"""The settings that are limits, with their units."""


def limits_of(connection: Connection, settings: Settings, *, all_owners: bool) -> list[Limit]:
    """All limits, with how much of each the owner of a connection uses.

    Parameters
    ----------
    all_owners : bool
        Whether to include how much all owners use together.
    """
    used = {
        "owner_captures": statistics.captures_and_uploads(connection),
        "owner_jobs": statistics.active_jobs(connection),
        "owner_bytes": statistics.stored_bytes(connection),
    }
    if all_owners:
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
    """Check that an owner may have more. Within the transaction that adds it, the result is certain.

    Parameters
    ----------
    size : int
        Bytes; with 0, the limits must still not be exceeded already.

    Raises
    ------
    NoRoom
        If something must be deleted first.
    TooMany
        If the owner must wait first.
    """
    if captures and settings.owner_captures is not None:
        value = statistics.captures_and_uploads(connection) + captures
        if value > settings.owner_captures:
            raise NoRoom(
                f"you may have {settings.owner_captures} captures, unfinished uploads included, and this would be the "
                f"{value}th; delete some first",
                name="owner_captures",
                limit=settings.owner_captures,
                value=value,
            )
    if jobs and settings.owner_jobs is not None:
        value = statistics.active_jobs(connection) + jobs
        if value > settings.owner_jobs:
            raise TooMany(
                f"you may have {settings.owner_jobs} queued or running jobs, ingests included, and this would be the "
                f"{value}th; wait for one to end, or cancel one",
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
            # For the whole service only what is missing: its usage would reveal that of other owners.
            raise NoRoom(
                f"{whose} {most} bytes stored, and this would be {value - most} more; delete captures, mattes, videos, "
                "uploads or programs first",
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
    """Check the same before something is uploaded, and that the disk has room for its bytes.

    Raises
    ------
    NoRoom, TooMany
    """
    admit(connection, settings, captures=captures, jobs=jobs, size=size)
    uploads.check_room(connection, objects, size)
