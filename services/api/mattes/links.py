"""Links to a matte for people without a key: made, listed and deleted by its owner, and the pages that they lead to."""

from dataclasses import replace
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Annotated, Any, Self

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Row

from services.api.auth import Caller
from services.api.context import OwnerContext, PublicContext
from services.api.http.bodies import has_body, json_body, read_json
from services.api.http.media_types import preferred
from services.api.http.router import Router
from services.api.mattes.live import live_page
from services.api.mattes.live_page import PAGE
from services.runtime.problems import MEDIA_TYPE
from storage.database.engine import reading, writing
from storage.database.owners import for_owner
from storage.errors import NotFound
from storage.records import links, mattes

router = Router(tags=["mattes"])
page = APIRouter(tags=["mattes"])
REQUEST_BYTES = 4 << 10
DAY = 86_400
"""Seconds."""
SANDBOX = "sandbox allow-scripts; frame-ancestors"
"""The page runs its own script, and nothing of it can reach the service: for the browser it is another site."""
FRESH = {"Cache-Control": "private, no-store"}
"""Asked for again each time, so that a deleted link shows nothing."""
GONE = (PAGE / "gone.html").read_text(encoding="utf-8")
"""What browsers show for a link that leads nowhere; other clients get the problem."""


class Link(BaseModel):
    """A link to a matte."""

    id: str
    created_at: datetime
    expires_at: datetime

    @classmethod
    def of(cls, row: Row[Any], **paths: str) -> Self:
        created, expires = (datetime.fromtimestamp(at, UTC) for at in (row.created_at, row.expires_at))
        return cls(id=row.id, created_at=created, expires_at=expires, **paths)


class NewLink(Link):
    """A link that was just made: only now is it known where it leads."""

    path: str = Field(
        description="The page, below the address of the service; anyone who has it sees the matte."
    )
    embed: str = Field(description="The same for an `iframe` in a page of any website.")


class Links(BaseModel):
    """The links to a matte, newest first."""

    links: list[Link]


class LinkRequest(BaseModel):
    """How long a link leads to the matte."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    days: float = Field(default=30, gt=0, le=3650, description="Days until the link expires, a fraction too.")


async def _link_request(request: Request) -> LinkRequest:
    return await read_json(request, LinkRequest, REQUEST_BYTES) if has_body(request) else LinkRequest()


@router.post(
    "/mattes/{id}/links",
    status_code=201,
    openapi_extra=json_body(LinkRequest),
)
def create_link(
    context: OwnerContext, id: str, given: Annotated[LinkRequest, Depends(_link_request)]
) -> NewLink:
    """Make a link by which anyone can see the matte, live before pictures of their own, but nothing else.

    Its path is in this answer only. The page has the matte as `GET /v1/mattes/{id}/live` sends it.
    """
    with writing(context.engine) as c:
        mattes.get_ready(c, id)
        token, row = links.create(c, id, given.days * DAY)
    return NewLink.of(row, path=f"/share/{token}", embed=f"/embed/{token}")


@router.get("/mattes/{id}/links")
def list_links(context: OwnerContext, id: str) -> Links:
    """The links to the matte that have not expired, newest first."""
    with reading(context.engine) as c:
        mattes.get(c, id)
        return Links(links=[Link.of(row) for row in links.list_all(c, id)])


@router.delete("/mattes/{id}/links/{link}", status_code=204)
def delete_link(context: OwnerContext, id: str, link: str) -> None:
    """Delete a link: it leads nowhere from now on."""
    with writing(context.engine) as c:
        mattes.get(c, id)
        links.remove(c, id, link)


@page.get("/share/{token}", response_class=Response, responses={200: {"content": {"text/html": {}}}})
async def get_shared(context: PublicContext, token: str, request: Request) -> Response:
    """The page that a link leads to."""
    return await _shown(context, token, request, {"Content-Security-Policy": f"{SANDBOX} 'none'"})


@page.get("/embed/{token}", response_class=Response, responses={200: {"content": {"text/html": {}}}})
async def get_embedded(context: PublicContext, token: str, request: Request) -> Response:
    """The same page, which pages of other websites may show in an `iframe`."""
    anywhere = {"Content-Security-Policy": f"{SANDBOX} *", "Cross-Origin-Resource-Policy": "cross-origin"}
    return await _shown(context, token, request, anywhere)


async def _shown(context: PublicContext, token: str, request: Request, headers: dict[str, str]) -> Response:
    def find() -> Row[Any]:
        with reading(context.engine) as c:
            return links.find(c, token)

    try:
        row = await context.call(find)
    except NotFound:
        if preferred(request.headers.get("accept", "*/*"), (MEDIA_TYPE, "text/html")) != "text/html":
            raise
        return HTMLResponse(GONE, HTTPStatus.NOT_FOUND, headers | FRESH)
    # What it costs counts as its owner's.
    bound = replace(context, engine=for_owner(context.engine, row.owner), caller=Caller(row.owner, "read"))
    return await live_page(bound, row.matte, request, lambda _: headers | FRESH)
