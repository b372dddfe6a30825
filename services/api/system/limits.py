"""Limits of the service and of its owners, over HTTP."""

from pydantic import BaseModel, Field

from services.api.context import OwnerContext
from services.api.http.router import Router
from services.api.limits.quotas import Unit, limits_of
from storage.database.engine import reading

router = Router(tags=["system"])


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
        found = limits_of(c, context.settings, all_owners=caller.may("admin"))
    limits = [Limit.model_validate(limit, from_attributes=True) for limit in found]
    return Limits(owner=caller.owner, scope=caller.scope, limits=limits)
