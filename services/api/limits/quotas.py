"""Limits of owners and of the whole service, checked before anything is accepted."""

from dataclasses import dataclass

from sqlalchemy import Connection

from services.settings import Settings
from storage import statistics
from storage.database.disk_reserve import file_of
from storage.disks import require_reserve
from storage.errors import NEARLY_FULL, NoRoom, TooMany
from storage.objects import marker
from storage.objects.store import Objects


@dataclass(frozen=True)
class NewData:
    """What a request is about to add.

    Attributes
    ----------
    captures, jobs : int
    size : int
        Bytes that it keeps; with 0, the limits must still not be exceeded already.
    room : int
        Bytes that the disk must have in addition, while it is at work.
    """

    captures: int = 0
    jobs: int = 0
    size: int = 0
    room: int = 0


NOTHING = NewData()
DELETE = "delete captures, mattes, videos, uploads, programs or ended jobs first"


def admit(connection: Connection, settings: Settings, wanted: NewData = NOTHING) -> None:
    """Check that an owner may have more. Within the transaction that adds it, the result is certain.

    Raises
    ------
    NoRoom
        If something must be deleted first.
    TooMany
        If the owner must wait first.
    """
    _admit_owner(connection, settings, wanted)
    # What others have only promised to send is of no account here, see `admit_upload`.
    if (room := _room_of_service(connection, settings)) is not None:
        _check_service(settings, wanted.size, wanted.size - room)


def admit_upload(connection: Connection, settings: Settings, objects: Objects, wanted: NewData) -> None:
    """Check the same before something is uploaded, and that the disk has room for its bytes.

    Room that other owners were promised for uploads is kept for them, but never more than half of what there is: so
    nobody can lock out the others by promises. What is promised twice is refused when its bytes come.

    Raises
    ------
    NoRoom, TooMany
    """
    _admit_owner(connection, settings, wanted)
    own = statistics.promised_bytes(connection)
    others = statistics.promised_bytes(connection, all_owners=True) - own

    def lacking(free: int, size: int) -> int:
        return size + own + min(others, max(free, 0) // 2) - free

    if (free := _room_of_service(connection, settings)) is not None:
        _check_service(settings, wanted.size, lacking(free, wanted.size))
    most = wanted.size + wanted.room
    if (free := _room_on_disk(connection, objects)) is not None and lacking(free, most) > 0:
        missing = lacking(free, most)
        raise NoRoom(
            f"the store has no room for {most} bytes. Delete captures, mattes or uploads, or free {missing} "
            "bytes on the disk",
            missing=missing,
        )


def admit_bytes(connection: Connection, settings: Settings, objects: Objects) -> None:
    """Check that there is room for what this transaction has reserved for a body that is coming.

    Raises
    ------
    NoRoom
    """
    admit(connection, settings)
    free = _room_on_disk(connection, objects)
    if free is not None and free < 0:
        raise NoRoom(NEARLY_FULL, missing=-free)


def _admit_owner(connection: Connection, settings: Settings, wanted: NewData) -> None:
    """Check the limits of an owner, and that the database has room for rows."""
    if wanted.captures and settings.owner_captures is not None:
        value = statistics.captures_and_uploads(connection) + wanted.captures
        if value > settings.owner_captures:
            raise NoRoom(
                f"you may have {settings.owner_captures} captures, unfinished uploads included, and this would be "
                f"number {value}; delete some first",
                name="owner_captures",
                limit=settings.owner_captures,
                value=value,
            )
    if wanted.jobs and settings.owner_jobs is not None:
        value = statistics.active_jobs(connection) + wanted.jobs
        if value > settings.owner_jobs:
            raise TooMany(
                f"you may have {settings.owner_jobs} queued or running jobs, ingests included, and this would be "
                f"number {value}; wait for one to end, or cancel one",
                name="owner_jobs",
                limit=settings.owner_jobs,
                value=value,
            )
    if settings.owner_bytes is not None:
        value = statistics.stored_bytes(connection) + wanted.size
        if value > settings.owner_bytes:
            missing = value - settings.owner_bytes
            raise NoRoom(
                f"you may have {settings.owner_bytes} bytes stored, and this would be {missing} more; {DELETE}",
                name="owner_bytes",
                limit=settings.owner_bytes,
                value=value,
                missing=missing,
            )
    if (file := file_of(connection.engine)) is not None:
        require_reserve(file.parent)


def _check_service(settings: Settings, size: int, missing: int) -> None:
    """Refuse bytes if some are missing for them; only these are named, as all that is used reveals what others have."""
    if missing > 0:
        raise NoRoom(
            f"this service may have {settings.store_bytes} bytes stored, and this would be {missing} more; {DELETE}",
            name="store_bytes",
            limit=settings.store_bytes or 0,
            value=size,
            missing=missing,
        )


def _room_of_service(connection: Connection, settings: Settings) -> int | None:
    """Bytes that all owners together may still send; None without a limit."""
    if settings.store_bytes is None:
        return None
    return settings.store_bytes - statistics.received_bytes(connection, all_owners=True)


def _room_on_disk(connection: Connection, objects: Objects) -> int | None:
    """Bytes of the disk that uploads may take, without those that bodies under way have reserved."""
    marker.require_mounted(objects)
    objects.require_reserve()  # of files too
    spare = objects.spare_bytes()
    return None if spare is None else spare - statistics.coming_bytes(connection)
