"""Archives of mattes over HTTP: download a matte, all of it or entry by entry, and import it into another service."""

import logging
from collections.abc import Iterator
from functools import partial
from typing import Annotated, Any

import anyio.to_thread
from fastapi import Query, Request, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import Connection, Row
from starlette.types import Receive, Scope, Send

from services.api.context import Context, OwnerContext
from services.api.http.bodies import store_as_upload, upload_limit
from services.api.http.idempotency import IdempotencyKey, find_earlier, idempotent
from services.api.http.media_types import ZIP, require_media_type
from services.api.http.responses import bytes_response
from services.api.http.router import Router
from services.api.limits.quotas import NewData, admit
from services.api.limits.reservations import reserved
from services.api.mattes.mattes import Matte, save_as, title_of
from services.runtime.problems import Unauthorized
from storage.database.rows import new_id
from storage.errors import Corrupt, NoRoom, NotFound
from storage.layout import mattes as stored_mattes
from storage.layout import uploads as stored_uploads
from storage.layout.matte_archive import Archive, is_entry, may_lack
from storage.layout.uploads import Part
from storage.records import bodies, mattes
from workflows.mattes.imports.importing import bytes_of_import, take_in
from workflows.untrusted.validation import Name

logger = logging.getLogger(__name__)
router = Router(tags=["mattes"])
CALL = "POST /v1/mattes"
BYTES = "application/octet-stream"
ENTRY_BYTES = 16 << 20
"""What an entry takes beside other answers: the rows T of a block, above all."""
ARCHIVE_BYTES = 1 << 30
"""Of an archive, which may take ENVMATTE_REQUEST_SECONDS; a larger one may take as much longer."""


@router.get(
    "/mattes/{id}/archive",
    response_class=StreamingResponse,
    responses={200: {"content": {ZIP: {}}, "description": "The archive"}},
)
async def get_archive(context: OwnerContext, id: str) -> Response:
    """A whole matte as one ZIP. Any zarr reader can open it, and `POST /v1/mattes` of another service can import it.

    The same matte always gives the same bytes. If the matte is deleted or the key revoked during the download, the
    connection ends early.
    """
    return _Download(context, id)


class _Download(Response):
    """The archive of a matte, opened and sent once it is its owner's turn."""

    def __init__(self, context: Context, id: str) -> None:
        super().__init__()
        self._context, self._id = context, id

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        context = self._context
        async with context.shares.archives.take(context.caller.owner, context.settings.request_seconds):
            # To open it is to make a list of its entries, which ends if nobody waits for the archive any more.
            archive, title = await context.compute(Request(scope, receive), context.shares.lists, self._open)
            headers = {"Content-Length": str(archive.size)} | save_as(self._id, title, ".zip")
            response = StreamingResponse(self._pieces(archive), media_type=ZIP, headers=headers)
            try:
                await response(scope, receive, send)
            except (NotFound, Unauthorized, Corrupt) as error:
                # The answer has begun, so it can't become a problem: without its end, the server disconnects.
                level = logging.ERROR if isinstance(error, Corrupt) else logging.INFO
                logger.log(level, "ended the download of matte %s: %s", self._id, error.detail)

    def _open(self) -> tuple[Archive, str]:
        with self._context.stored(mattes.get_ready, self._id) as row:
            return Archive(self._context.objects, self._id), title_of(self._context, row)

    def _pieces(self, archive: Archive) -> Iterator[bytes]:
        with self._context.stored(mattes.get_ready, self._id):
            yield from self._context.while_allowed(archive)


@router.get(
    "/mattes/{id}/zarr/{entry:path}",
    response_class=Response,
    responses={200: {"content": {BYTES: {}}, "description": "The entry"}},
)
async def get_entry(context: OwnerContext, id: str, entry: str, request: Request) -> Response:
    """One entry of a matte's archive, such as `zarr.json` or `S/c/0/0/0`.

    So `/v1/mattes/{id}/zarr` is a zarr group that readers open where it is, and read chunk by chunk.
    """

    def read() -> Response:
        with context.stored(mattes.get_ready, id):
            if not is_entry(context.cache.matte(id), entry):
                raise NotFound(f"matte {id} has no entry {entry}")
            try:
                (data,) = context.objects.get([f"{stored_mattes.path(id)}/{entry}"])
            except Corrupt as error:
                if not may_lack(entry):
                    raise
                raise NotFound(f"{entry} of matte {id} is empty") from error
            return bytes_response(data, BYTES)

    return await context.compute(request, context.shares.memory, read, ENTRY_BYTES)


@router.post(
    "/mattes",
    status_code=201,
    openapi_extra={"requestBody": {"content": {ZIP: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def post_archive(
    context: OwnerContext,
    request: Request,
    response: Response,
    name: Annotated[Name, Query(description="A name for people.")] = "",
    idempotency_key: IdempotencyKey = None,
) -> Matte:
    """Import a matte: the body is an archive from `GET /v1/mattes/{id}/archive`.

    The whole archive is checked before the answer, which takes some seconds for each 100 MB.
    """
    require_media_type(request, ZIP, "the archive of a matte")
    row = await _from_body(context, request, name, idempotency_key)
    response.headers["Location"] = f"/v1/mattes/{row.id}"
    return Matte.of(row)


async def _from_body(context: Context, request: Request, name: str, key: str | None) -> Row[Any]:
    """Stream an archive into the store and import its matte; the archive is removed in any case."""
    limit = upload_limit(context.settings)
    length = limit.check_announced(request)
    earlier = await context.call(find_earlier, context.engine, key, CALL, mattes.get)
    if earlier is not None:
        return earlier
    matte = new_id()
    # The disk has to hold the archive, and the matte.
    wanted = NewData(size=length, room=length)
    async with reserved(context, matte, wanted, context.settings.upload_bytes) as reservation:
        try:
            part = await store_as_upload(reservation.watch(limit.stream(request)), context.objects, matte)
            row = await context.compute(
                request,
                context.shares.imports,
                partial(_import, context, matte, part, name, key),
                memory=bytes_of_import(context.settings.limits),
                seconds=context.settings.request_seconds * -(-part.size // ARCHIVE_BYTES),
            )
        finally:
            # If the server is killed, the coordinator sweeps the archive and half a matte: nothing refers to them.
            await anyio.to_thread.run_sync(stored_uploads.remove, context.objects, matte)
    return row


def _import(context: Context, matte: str, part: Part, name: str, key: str | None) -> Row[Any]:
    """Import the matte of an archive that is stored."""
    context.check_key()
    objects = context.objects
    stored_uploads.seal(objects, matte, [part])
    with stored_uploads.read(objects, matte) as file:
        imported = take_in(file, objects, matte, context.settings.limits)
    stored = sum(objects.sizes(stored_mattes.path(matte)).values())
    kept = context.settings.matte_seconds

    def create(c: Connection) -> str:
        bodies.release(c, matte)
        admit(c, context.settings, NewData(size=stored))
        mattes.add_imported(c, matte, imported.attributes["options"], imported.figures, stored, kept, name)
        return matte

    try:
        row = idempotent(context.engine, key, CALL, mattes.get, create, matte)
    except (NoRoom, NotFound):
        # After any other error the row may have been written; if it was not, the coordinator sweeps the matte.
        objects.delete(stored_mattes.path(matte))
        raise
    if row.id != matte:  # a concurrent request with the same key was quicker
        objects.delete(stored_mattes.path(matte))
    return row
