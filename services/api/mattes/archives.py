"""Archives of mattes over HTTP: one leaves, and comes back."""

from typing import Any

import anyio.to_thread
from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import Connection, Row

from services.api.captures.captures import ONLY
from services.api.context import Context, OwnerContext
from services.api.http.bodies import store_body, upload_limit
from services.api.http.idempotency import IdempotencyKey, find_earlier, idempotent
from services.api.http.media_types import ZIP, require_media_type
from services.api.mattes.mattes import Matte
from services.api.quotas import admit
from storage.database.engine import reading
from storage.database.rows import new_id
from storage.errors import NoRoom, NotFound
from storage.layout import mattes as stored_mattes
from storage.layout import uploads as stored_uploads
from storage.layout.matte_archive import Archive
from storage.layout.uploads import Part
from storage.records import mattes, uploads
from workflows.mattes.imports.importing import take_in

router = APIRouter(tags=["mattes"])
CALL = "POST /v1/mattes"


@router.get(
    "/mattes/{id}/archive",
    response_class=StreamingResponse,
    responses={200: {"content": {ZIP: {}}, "description": "The archive"}},
)
def get_archive(context: OwnerContext, id: str) -> StreamingResponse:
    """All of a matte in one ZIP, which any zarr reader opens, and which `POST /v1/mattes` takes elsewhere.

    The same matte makes the same bytes. Where the matte is deleted or the key revoked meanwhile, the connection ends
    early.
    """
    with reading(context.engine) as c:
        mattes.get_ready(c, id)
    archive = Archive(context.objects, id)
    headers = {
        "Content-Length": str(archive.size),
        "Content-Disposition": f'attachment; filename="matte-{id}.zip"',
    }
    return StreamingResponse(context.while_allowed(archive), media_type=ZIP, headers=headers)


@router.post(
    "/mattes",
    status_code=201,
    openapi_extra={"requestBody": {"content": {ZIP: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def post_archive(
    context: OwnerContext, request: Request, response: Response, idempotency_key: IdempotencyKey = None
) -> Matte:
    """Make a matte of an archive: the body is what `GET /v1/mattes/{id}/archive` gave.

    All of it is checked before the answer, which takes some seconds for each 100 MB.
    """
    require_media_type(request, ZIP, "the archive of a matte")
    row = await _from_body(context, request, idempotency_key)
    response.headers["Location"] = f"/v1/mattes/{row.id}"
    return Matte.of(row)


async def _from_body(context: Context, request: Request, key: str | None) -> Row[Any]:
    """Stream an archive into the store, and make a matte of it; the archive is gone in the end."""
    limit = upload_limit(context.settings)
    length = limit.check_announced(request)
    earlier = await anyio.to_thread.run_sync(find_earlier, context.engine, key, CALL, mattes.get)
    if earlier is not None:
        return earlier
    await anyio.to_thread.run_sync(_admit, context, length)
    matte = new_id()
    try:
        size = await store_body(request, context.objects, stored_uploads.part_path(matte, ONLY), limit)
        row = await anyio.to_thread.run_sync(_import, context, matte, size, key, limiter=context.imports)
    finally:
        # One that a killed server leaves, and half of its matte, are swept: nothing refers to them.
        await anyio.to_thread.run_sync(stored_uploads.remove, context.objects, matte)
    return row


def _import(context: Context, matte: str, size: int, key: str | None) -> Row[Any]:
    context.check_key()
    objects = context.objects
    stored_uploads.seal(objects, matte, [Part(ONLY, size)])
    with stored_uploads.read(objects, matte) as file:
        made = take_in(file, objects, matte, context.settings.limits)
    stored = sum(objects.sizes(stored_mattes.path(matte)).values())
    kept = context.settings.matte_seconds

    def create(c: Connection) -> str:
        admit(c, context.settings, size=stored)
        mattes.add_imported(c, matte, made.attributes["options"], made.figures, stored, kept)
        return matte

    try:
        row = idempotent(context.engine, key, CALL, mattes.get, create)
    except (NoRoom, NotFound):
        # After any other error the row may have been written; if it was not, the coordinator sweeps the matte.
        objects.delete(stored_mattes.path(matte))
        raise
    if row.id != matte:  # a repeat with the same key was quicker
        objects.delete(stored_mattes.path(matte))
    return row


def _admit(context: Context, length: int) -> None:
    with reading(context.engine) as c:
        admit(c, context.settings, size=length)
        uploads.check_room(c, context.objects, 2 * length)  # the archive, and the matte beside it
