"""Requests that go on after their key was checked, against a real database."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from services.api.auth import identify
from services.api.context import KEY_CHECK, Context
from services.api.work import Shares
from services.decoding.pool import Decoders
from services.runtime.problems import Unauthorized
from services.settings import Settings
from storage.database.engine import open_engine, writing
from storage.objects.store import Objects
from storage.records import api_keys
from workflows.composite.cache import Cache


def test_download_ends_when_its_key_is_revoked(tmp_path: Path) -> None:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
    with writing(engine) as c:
        key = api_keys.create(c, "lab", "alice", "read")
    settings, objects = Settings(data=tmp_path), Objects((tmp_path / "store").as_uri())
    check_key = partial(identify, settings, engine, key)
    decoders = Decoders(settings.backdrop_bytes)  # no process starts before the first picture
    memory = Shares(1, 1)
    context = Context(settings, engine, objects, Cache(objects, 0), decoders, memory, check_key=check_key)

    def pieces() -> Iterator[bytes]:
        for n in range(5):
            if n == 3:
                with writing(engine) as c:
                    api_keys.revoke(c, "lab")
            time.sleep(1.1 * KEY_CHECK)
            yield bytes([n])

    sent: list[bytes] = []
    with pytest.raises(Unauthorized):
        sent.extend(context.while_allowed(pieces()))
    engine.dispose()
    assert sent == [b"\0", b"\1", b"\2"]
