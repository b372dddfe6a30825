"""Creating captures over HTTP: from a capture archive as the body, or from a finished upload."""

import logging
from functools import partial
from typing import Annotated, Any

import anyio.to_thread
from fastapi import Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, Row

from services.api.captures.captures import Capture, capture_response
from services.api.captures.tus import file_name
from services.api.context import Context, OwnerContext
from services.api.http.bodies import read_json, schema_of, store_as_upload, upload_limit
from services.api.http.idempotency import IdempotencyKey, find_earlier, idempotent
from services.api.http.media_types import JSON, ZIP, media_type_of
from services.api.http.router import Router
from services.api.limits.quotas import NewData, admit
from services.api.limits.reservations import reserved
from services.runtime import tracing
from services.runtime.problems import WrongMediaType
from services.webhooks.sender import check_webhook
from storage.database.engine import reading, writing
from storage.database.rows import new_id
from storage.errors import CaptureError, Conflict, Corrupt, NotFound
from storage.layout import uploads as stored_uploads
from storage.layout.uploads import Part
from storage.records import bodies, captures, jobs, uploads
from workflows.ingest.archive import CaptureArchive
from workflows.interruption import checkpoint
from workflows.untrusted.validation import Name

logger = logging.getLogger(__name__)
router = Router(tags=["captures"])
CALL = "POST /v1/captures"
FROM_UPLOAD_BYTES = 1 << 16
CHECK_BYTES = 200 << 20
"""What checking a capture archive takes at most: its directory, and its capture.json with a program."""


class FromUpload(BaseModel):
    """A finished upload to create a capture from."""

    model_config = ConfigDict(extra="forbid")
    upload: str
    name: Name = ""
    webhook: str | None = Field(
        None, description="URL, https, that is notified when the capture is ingested."
    )


@router.post(
    "/captures",
    status_code=201,
    response_model=Capture,
    openapi_extra={
        "requestBody": {
            "content": {
                ZIP: {"schema": {"type": "string", "format": "binary"}},
                JSON: {"schema": schema_of(FromUpload)},
            }
        }
    },
)
async def upload(
    context: OwnerContext,
    request: Request,
    name: Annotated[Name, Query(description="A name for people.")] = "",
    webhook: Annotated[
        str | None, Query(description="URL, https, that is notified when the capture is ingested.")
    ] = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Create a capture. The body is its ZIP, in the format envmatte-capture/1, or names the upload that holds the ZIP.

    `name` and `webhook` of the query are for a ZIP; JSON has its own.
    """
    media_type = media_type_of(request)
    if media_type == JSON:
        given = await read_json(request, FromUpload, FROM_UPLOAD_BYTES)
        create = partial(_from_upload, context, given, idempotency_key)
        row = await context.compute(request, context.shares.captures, create, memory=CHECK_BYTES)
    elif media_type == ZIP:
        row = await _from_body(context, request, name, idempotency_key, webhook)
    else:
        raise WrongMediaType(
            f"send the ZIP of a capture as {ZIP}, not as {media_type or 'nothing'}, or the id of a finished upload "
            f"as {JSON}"
        )

    def respond() -> Response:
        with reading(context.engine) as c:
            return capture_response(c, row.id)

    response = await context.call(respond)
    response.status_code = 201
    response.headers["Location"] = f"/v1/captures/{row.id}"
    return response


async def _from_body(
    context: Context, request: Request, name: str, key: str | None, webhook: str | None
) -> Row[Any]:
    """Stream the archive into the store and create its capture; if anything fails, nothing is kept."""
    check_webhook(webhook, context.settings)
    limit = upload_limit(context.settings)
    length = limit.check_announced(request)
    earlier = await context.call(_find_earlier, context, key)
    if earlier is not None:
        return earlier
    capture = new_id()
    most = context.settings.upload_bytes
    remove = partial(stored_uploads.remove, context.objects, capture)
    wanted = NewData(captures=1, jobs=1, size=length)
    async with reserved(context, capture, wanted, most, remove) as reservation:
        pieces = reservation.watch(limit.stream(request))
        parts = [await store_as_upload(pieces, context.objects, capture)]
        register = partial(_register, context, capture, parts, key, name=name, webhook=webhook)
        row = await context.compute(request, context.shares.captures, register, memory=CHECK_BYTES)
    if row.id != capture:  # a concurrent request with the same key was quicker
        await anyio.to_thread.run_sync(remove)
    return row


def _from_upload(context: Context, given: FromUpload, key: str | None) -> Row[Any]:
    """Create a capture from a finished upload, with the same id; a repeated request is answered with it."""
    upload = given.upload
    check_webhook(given.webhook, context.settings)
    earlier = _find_earlier(context, key)
    if earlier is not None:
        return earlier
    with reading(context.engine) as c:
        if captures.exists(c, upload):
            return captures.get(c, upload)
        row = uploads.get(c, upload)
        parts = uploads.parts_of(c, upload)
    if row.offset < row.length:
        raise Conflict(
            f"upload {upload} has {row.offset} of its {row.length} bytes; send the rest first",
            offset=row.offset,
        )
    try:
        return _register(context, upload, parts, key, name=given.name, webhook=given.webhook, finished=row)
    except (CaptureError, Corrupt, FileNotFoundError, NotFound) as error:
        is_useless = not isinstance(error, NotFound)  # it would be refused again
        with writing(context.engine) as c:
            if captures.exists(c, upload):  # a concurrent request was quicker
                return captures.get(c, upload)
            uploads.get(c, upload)
            if is_useless:
                uploads.delete(c, upload)
        if is_useless:
            stored_uploads.remove(context.objects, upload)
        if isinstance(error, (Corrupt, FileNotFoundError)):
            logger.error("deleted upload %s, which cannot be read: %s", upload, error)
            raise NotFound(
                f"bytes of upload {upload} are missing or damaged in the store, so it was deleted; start a new upload"
            ) from error
        raise


def _find_earlier(context: Context, key: str | None) -> Row[Any] | None:
    return find_earlier(context.engine, key, CALL, captures.get)


def _register(
    context: Context,
    capture: str,
    parts: list[Part],
    key: str | None,
    *,
    name: str,
    webhook: str | None,
    finished: Row[Any] | None = None,
) -> Row[Any]:
    """Check a complete archive, and add the rows of its capture and of the ingest job.

    Parameters
    ----------
    capture : str
        The id, under which the parts are stored.
    key : str, optional
        The Idempotency-Key.
    name : str
        The capture has the first name that there is: this, that in the manifest, or that of an uploaded file.
    finished : Row, optional
        The row of a resumable upload, which ends with this.
    """
    context.check_key()
    stored_uploads.seal(context.objects, capture, parts)
    with stored_uploads.read(context.objects, capture) as stored:
        manifest = CaptureArchive(stored, context.settings.limits).manifest
    checkpoint()

    def create(c: Connection) -> str:
        if finished is not None and not uploads.delete(c, capture):
            raise NotFound(f"upload {capture} does not exist any more")
        bodies.release(c, capture)
        size = sum(part.size for part in parts)
        admit(c, context.settings, NewData(captures=1, jobs=1, size=size))
        job = jobs.add(c, "ingest", capture, {}, trace=tracing.current_traceparent(), webhook=webhook)
        captures.add(
            c,
            capture,
            job,
            name=name or manifest.name or (file_name(finished.metadata) if finished is not None else ""),
            seconds=context.settings.capture_seconds,
            bytes=size,
            frames=len(manifest.frames) or manifest.program.count,
            program=manifest.program.model_dump(mode="json"),
        )
        return capture

    return idempotent(context.engine, key, CALL, captures.get, create, capture)
