"""Limits of bodies, announced or not."""

import asyncio
import tempfile
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import pytest
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from starlette.requests import Request

from services.api.http.bodies import BodyLimit, has_body, read_json, schema_of, spool_body, upload_limit
from services.runtime.problems import TooLarge
from services.settings import Settings
from storage.errors import NoRoom
from tests.parts.disks import small_disk


def request(parts: Sequence[bytes] = (), **headers: str) -> Request:
    messages = iter(parts)

    async def receive() -> dict[str, object]:
        part = next(messages, None)
        return {"type": "http.request", "body": part or b"", "more_body": part is not None}

    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    return Request({"type": "http", "headers": raw}, receive)


async def collect(parts: AsyncIterator[bytes]) -> list[bytes]:
    return [part async for part in parts if part]


def test_announced_length_over_the_limit_is_refused() -> None:
    limit = upload_limit(Settings(_env_file=None, upload_bytes=10), "a clip")
    assert limit.check_announced(request(content_length="10")) == 10
    assert limit.check_announced(request()) == 0
    with pytest.raises(TooLarge, match="a clip may have 10 bytes") as caught:
        limit.check_announced(request(content_length="11"))
    assert caught.value.fields == {"name": "upload_bytes", "limit": 10, "value": 11}


def test_body_over_the_limit_is_refused_while_it_arrives() -> None:
    assert asyncio.run(collect(BodyLimit(4).stream(request([b"ab", b"cd"])))) == [b"ab", b"cd"]
    with pytest.raises(TooLarge, match="may have 3 bytes") as caught:
        asyncio.run(collect(BodyLimit(3).stream(request([b"ab", b"cd", b"ef"]))))
    assert caught.value.fields == {"limit": 3}


def test_earlier_bytes_count_towards_the_limit() -> None:
    with pytest.raises(TooLarge):
        BodyLimit(4).check_announced(request(content_length="2"), start=3)
    with pytest.raises(TooLarge):
        asyncio.run(collect(BodyLimit(4).stream(request([b"ab"]), start=3)))


def test_spooled_body_is_read_from_its_start() -> None:
    async def spooled(limit: int) -> bytes:
        async with spool_body(request([b"ab", b"cd"]), limit) as file:
            return file.read()

    assert asyncio.run(spooled(4)) == b"abcd"
    with pytest.raises(TooLarge):
        asyncio.run(spooled(3))


def test_spooled_body_leaves_the_disk_its_reserve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def spooled() -> int:
        async with spool_body(request([bytes(1 << 20)] * 32), 32 << 20) as file:
            return file.seek(0, 2)

    with small_disk(tmp_path / "disk", 16 << 20) as disk:
        monkeypatch.setattr(tempfile, "tempdir", str(disk))
        with pytest.raises(NoRoom, match="the disk is full, apart from a reserve"):
            asyncio.run(spooled())


class Inner(BaseModel):
    n: int


class Outer(BaseModel):
    inner: list[Inner]


def test_json_is_validated_with_its_place_in_the_body() -> None:
    assert asyncio.run(read_json(request([b'{"inner": ', b"[]}"]), Outer, 100)) == Outer(inner=[])
    with pytest.raises(RequestValidationError) as caught:
        asyncio.run(read_json(request([b'{"inner": [{"n": "x"}]}']), Outer, 100))
    assert caught.value.errors()[0]["loc"] == ("body", "inner", 0, "n")


def test_schema_has_no_references() -> None:
    schema = schema_of(Outer)
    assert "$defs" not in schema
    assert schema["properties"]["inner"]["items"]["properties"]["n"]["type"] == "integer"


def test_body_is_known_by_its_headers() -> None:
    assert has_body(request(content_length="1"))
    assert has_body(request(transfer_encoding="chunked"))
    assert not has_body(request(content_length="0"))
    assert not has_body(request())
