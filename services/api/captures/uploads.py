"""Resumable uploads over HTTP: tus 1.0 (https://tus.io/protocols/resumable-upload)."""

import time
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from email.utils import format_datetime
from typing import Any

import anyio.to_thread
from fastapi import Depends, Request, Response
from sqlalchemy import Row
from starlette.requests import ClientDisconnect

from services.api.captures.tus import (
    ALGORITHMS,
    CHUNK,
    EXTENSIONS,
    Checksum,
    byte_count,
    declared,
    metadata_of,
    refuse_extensions,
    require_version,
)
from services.api.context import Context, OwnerContext
from services.api.http.bodies import BodyLimit, has_body, upload_limit
from services.api.http.idempotency import IdempotencyKey
from services.api.http.media_types import require_media_type
from services.api.http.router import Router
from services.api.limits.quotas import NewData, admit_bytes, admit_upload
from services.api.limits.reservations import STEP, Reservation
from services.runtime.problems import Unauthorized
from storage.database.engine import reading, writing
from storage.database.rows import new_id
from storage.errors import Conflict, InvalidInput, NoRoom, NotFound, TooMany
from storage.layout import uploads as stored_uploads
from storage.layout.uploads import Part
from storage.objects.byte_objects import Writer
from storage.records import bodies, captures, uploads
from storage.records.uploads import MAX_PARTS

PART = 64 << 20
"""Bytes after which a part is recorded: the most that a killed server loses of one PATCH."""
POLL = 1.0
"""Seconds between two checks of a writer whether another request wants its upload."""

router = Router(prefix="/uploads", tags=["uploads"])
Versioned = Depends(require_version)


@router.options("", status_code=204, response_class=Response)
def get_protocol(context: OwnerContext, response: Response) -> None:
    """What the service supports: version, extensions, and the largest upload in bytes."""
    response.headers["Tus-Extension"] = EXTENSIONS
    response.headers["Tus-Checksum-Algorithm"] = ",".join(ALGORITHMS)
    response.headers["Tus-Max-Size"] = str(context.settings.upload_bytes)


@router.post("", status_code=201, dependencies=[Versioned], response_class=Response)
async def create_upload(
    context: OwnerContext,
    request: Request,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Start an upload of `Upload-Length` bytes; the body may be the first of them.

    A client that knows `frames`, `width` and `height` of the capture can send them in `Upload-Metadata`: they are
    checked against the limits before any bytes are sent. The capture itself is checked in any case.
    """
    refuse_extensions(request)
    length = byte_count(request, "Upload-Length")
    upload_limit(context.settings).check(length)
    checksum = Checksum.of(request)
    with_body = has_body(request)
    if with_body:
        _require_chunk(request)
    metadata = metadata_of(request)
    known, limits = declared(metadata), context.settings.limits
    if "frames" in known:
        limits.check_frames(known["frames"])
    if "width" in known and "height" in known:
        limits.check_pixels(known["width"], known["height"])
    row, new = await context.call(_create, context, length, metadata, idempotency_key)
    if with_body and new:
        try:
            row = await _append(context, request, row, checksum)
        except (InvalidInput, NoRoom, TooMany, Unauthorized):
            # A refusal has no Location: nobody could continue the upload, or delete it.
            await anyio.to_thread.run_sync(delete_upload, context, row.id)
            raise
    return Response(status_code=201, headers={"Location": f"/v1/uploads/{row.id}"} | _headers(row))


@router.head("/{id}", dependencies=[Versioned], response_class=Response)
def get_upload(context: OwnerContext, id: str) -> Response:
    """How far an upload is: `Upload-Offset` of `Upload-Length` bytes."""
    with reading(context.engine) as c:
        row = uploads.get(c, id)
    headers = {"Upload-Length": str(row.length), "Cache-Control": "no-store"} | _headers(row)
    return Response(headers=headers | ({"Upload-Metadata": row.metadata} if row.metadata else {}))


@router.patch("/{id}", status_code=204, dependencies=[Versioned], response_class=Response)
async def append(context: OwnerContext, request: Request, id: str) -> Response:
    """Send the bytes of an upload from `Upload-Offset` on.

    If the connection breaks, the bytes that came are kept. A body with an `Upload-Checksum` is kept whole or not at
    all.
    """
    row = await context.call(_get, context, id)
    _require_chunk(request)
    checksum = Checksum.of(request)
    uploads.check_offset(row, byte_count(request, "Upload-Offset"))
    if row.parts >= MAX_PARTS:
        raise InvalidInput(
            f"upload {id} has come in {row.parts} pieces, the most there may be; start again with larger ones",
            limit=MAX_PARTS,
        )
    row = await _append(context, request, row, checksum)
    return Response(status_code=204, headers=_headers(row))


@router.delete("/{id}", status_code=204, dependencies=[Versioned], response_class=Response)
def delete_upload(context: OwnerContext, id: str) -> None:
    """Delete an upload."""
    with writing(context.engine) as c:
        uploads.get(c, id)
        uploads.delete(c, id)
    stored_uploads.remove(context.objects, id)


async def _append(context: Context, request: Request, row: Row[Any], checksum: Checksum | None) -> Row[Any]:
    """Append a body to an upload; returns its row after that."""
    limit = BodyLimit(
        row.length,
        f"upload {row.id} has a length of {row.length} bytes, and more have come; send no more than the rest",
    )
    size = min(limit.check_announced(request, row.offset), STEP)
    writer = new_id()
    await _claim(context, row, writer, size)
    reservation = Reservation(context, writer, size, row.length - row.offset, POLL)
    try:
        # A client that falls silent is disconnected, see `services.api.http.slow_clients`.
        await _store(context, row, reservation, limit.stream(request, row.offset), checksum)
    finally:
        await anyio.to_thread.run_sync(reservation.release)
    return await context.call(_get, context, row.id)


async def _store(
    context: Context,
    row: Row[Any],
    reservation: Reservation,
    pieces: AsyncIterator[bytes],
    checksum: Checksum | None,
) -> None:
    """Store a body in parts: record each of them at once, or all of them together once the checksum is right."""
    body = reservation.watch(pieces)
    stored: list[Part] = []
    offset, more, stopped = row.offset, True, None
    try:
        while more:
            name = new_id()
            async with context.objects.write(stored_uploads.part_path(row.id, name)) as file:
                stored.append(Part(name, 0))
                size, more, stopped = await _write_part(file, body, checksum)
            stored[-1] = Part(name, size)
            if not size:
                empty = stored_uploads.part_path(row.id, stored.pop().name)
                await anyio.to_thread.run_sync(context.objects.delete, empty)
            if not checksum:
                args = context, row.id, offset, stored, reservation, not more
                offset = await context.call(_advance, *args)
                stored = []
        if stopped:
            raise stopped
        if checksum:
            checksum.check()
            await context.call(_advance, context, row.id, offset, stored, reservation, True)
    except Exception:
        # Not when cancelled: `_advance` may still be running in its thread. Then the next start removes the parts.
        await anyio.to_thread.run_sync(_remove_unrecorded, context, row.id, stored)
        raise


async def _write_part(
    file: Writer, body: AsyncIterator[bytes], checksum: Checksum | None
) -> tuple[int, bool, Conflict | None]:
    """Write the next `PART` bytes of a body; returns how many came, whether there may be more, and what stopped it.

    Without a checksum, what came is kept when the client goes, or when another request wants the upload.
    """
    size = 0
    try:
        async for data in body:
            size += len(data)
            if checksum:
                checksum.update(data)
            await file.write(data)
            if size >= PART:
                return size, True, None
    except (ClientDisconnect, Conflict) as error:
        if checksum:
            raise
        return size, False, error if isinstance(error, Conflict) else None
    return size, False, None


async def _claim(context: Context, row: Row[Any], writer: str, size: int) -> None:
    """Become the only writer of an upload; a request that writes it, and to which nothing comes, is asked to end."""

    def claim() -> bool:
        with reading(context.engine) as c:  # many may wait, and should not hold up other writers
            if bodies.has_writer(c, row.id):
                return False
        with writing(context.engine) as c:
            uploads.check_offset(uploads.get(c, row.id), row.offset)
            if not bodies.claim(c, writer, row.id, size):
                return False
            admit_bytes(c, context.settings, context.objects)
            return True

    def ask() -> None:
        with writing(context.engine) as c:
            bodies.ask_for(c, row.id)

    if await context.call(claim):
        return
    await context.call(ask)
    deadline = time.monotonic() + bodies.PATIENCE
    while time.monotonic() < deadline:
        await anyio.sleep(POLL / 4)
        if await context.call(claim):
            return
    raise Conflict(f"another request is writing upload {row.id}; request its offset and continue from there")


def _advance(
    context: Context, upload: str, offset: int, stored: list[Part], reservation: Reservation, last: bool
) -> int:
    """Record stored parts, which count for the upload from then on; the last of a request also end its claim."""
    context.check_key()
    size = sum(part.size for part in stored)
    with writing(context.engine) as c:
        if last:
            bodies.release(c, reservation.id)
        else:
            bodies.record(c, reservation.id, size)
        advanced = uploads.advance(c, upload, offset, stored, context.settings.upload_seconds)
    reservation.recorded(size)
    return advanced


def _remove_unrecorded(context: Context, upload: str, stored: list[Part]) -> None:
    """Remove parts that were stored but not recorded, and all other parts too if the upload has been deleted."""
    try:
        # A commit that the database has not acknowledged may have recorded them: it is over once another can begin.
        with writing(context.engine) as c:
            uploads.get(c, upload)
            recorded = uploads.parts_of(c, upload)
    except NotFound:
        with reading(context.engine) as c:
            is_capture = captures.exists(c, upload)
        if not is_capture:
            stored_uploads.remove(context.objects, upload)
        raise
    for part in set(stored) - set(recorded):
        context.objects.delete(stored_uploads.part_path(upload, part.name))


def _get(context: Context, upload: str) -> Row[Any]:
    with reading(context.engine) as c:
        return uploads.get(c, upload)


def _create(context: Context, length: int, metadata: str, key: str | None) -> tuple[Row[Any], bool]:
    """Create an upload, or find the one that an earlier request with the same key created; returns whether it is new.

    Unlike other keys, that of an upload can be used again once the upload is gone.
    """
    with writing(context.engine) as c:
        expired = uploads.delete_expired(c)
    for upload in expired:
        stored_uploads.remove(context.objects, upload)
    with writing(context.engine) as c:
        row = uploads.by_key(c, key) if key else None
        if row is not None:
            return row, False
        admit_upload(c, context.settings, context.objects, NewData(captures=1, size=length))
        upload = new_id()
        uploads.add(c, upload, length, metadata, context.settings.upload_seconds, key or None)
        return uploads.get(c, upload), True


def _headers(row: Row[Any]) -> dict[str, str]:
    expires = format_datetime(datetime.fromtimestamp(row.expires_at, UTC), usegmt=True)
    return {"Upload-Offset": str(row.offset), "Upload-Expires": expires}


def _require_chunk(request: Request) -> None:
    require_media_type(request, CHUNK, "the bytes of an upload")
