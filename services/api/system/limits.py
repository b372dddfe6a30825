"""Limits of the service and of its owners, over HTTP."""

from typing import Literal

from pydantic import BaseModel, Field

from services.api.context import OwnerContext
from services.api.http.router import Router
from services.settings import Settings
from storage import statistics
from storage.database.engine import reading

router = Router(tags=["system"])
Unit = Literal["bytes", "frames", "pixels", "captures", "jobs", "seconds"]
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


class Limit(BaseModel):
    """A limit. Its setting is `ENVMATTE_` and the name in capitals."""

    name: str
    unit: Unit
    limit: int | None = Field(description="Null if unlimited.")
    used: int | None = Field(
        description="How much is in use; null if the limit is for each item, or for all owners together."
    )
    description: str


class Limits(BaseModel):
    """The caller's owner and scope, and the limits."""

    owner: str
    scope: str
    limits: list[Limit]


@router.get("/limits")
def get_limits(context: OwnerContext) -> Limits:
    """All limits, and how much of each the caller's owner uses. Admins also see how much the whole service uses."""
    caller = context.caller
    with reading(context.engine) as c:
        used = {
            "owner_captures": statistics.captures_and_uploads(c),
            "owner_jobs": statistics.active_jobs(c),
            "owner_bytes": statistics.stored_bytes(c),
        }
        if caller.may("admin"):
            used["store_bytes"] = statistics.stored_bytes(c, all_owners=True)
    limits = [
        Limit(
            name=name,
            unit=unit,
            limit=getattr(context.settings, name),
            used=used.get(name),
            description=str(Settings.model_fields[name].description),
        )
        for name, unit in UNITS.items()
    ]
    return Limits(owner=caller.owner, scope=caller.scope, limits=limits)
