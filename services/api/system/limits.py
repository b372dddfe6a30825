"""Limits over HTTP."""

from fastapi import APIRouter
from pydantic import BaseModel, Field

from services.api.context import OwnerContext
from services.api.quotas import Unit, limits_of
from storage.database.engine import reading

router = APIRouter(tags=["system"])


class Limit(BaseModel):
    """A limit; `ENVMATTE_` and its name in capitals is the setting."""

    name: str
    unit: Unit
    limit: int | None = Field(description="Null if there is none.")
    used: int | None = Field(description="Of it, now; null where it is one of each thing, or of all owners.")
    description: str


class Limits(BaseModel):
    """What the caller may, and has."""

    owner: str
    scope: str
    limits: list[Limit]


@router.get("/limits")
def get_limits(context: OwnerContext) -> Limits:
    """Every limit, and what of it the caller's owner has used; of the whole service for admins alone."""
    caller = context.caller
    with reading(context.engine) as c:
        found = limits_of(c, context.settings, whole=caller.may("admin"))
    limits = [Limit.model_validate(one, from_attributes=True) for one in found]
    return Limits(owner=caller.owner, scope=caller.scope, limits=limits)
