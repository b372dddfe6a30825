"""Keys and what they allow, with a real database."""

from pathlib import Path

import pytest
from sqlalchemy import Engine

from services.api.auth import ADMIN, ANYONE, Caller, identify, require_keys_unless_loopback
from services.runtime.problems import Unauthorized
from services.settings import Settings
from storage.database.engine import writing
from storage.errors import InvalidInput
from storage.records import api_keys


def test_service_that_never_had_a_key_is_open(engine: Engine, tmp_path: Path) -> None:
    assert identify(Settings(data=tmp_path), engine, None) == ANYONE
    assert identify(Settings(data=tmp_path), engine, "any") == ANYONE


def test_service_stays_closed_after_its_last_key_is_revoked(engine: Engine, tmp_path: Path) -> None:
    with writing(engine) as c:
        key = api_keys.create(c, "lab", "alice", "read")
    settings = Settings(data=tmp_path)
    assert identify(settings, engine, key) == Caller("alice", "read", number=1)
    with writing(engine) as c:
        api_keys.revoke(c, "lab")
    for given in (None, key, "", "any", "é"):
        reason = "Authorization: Bearer KEY" if given is None else "does not know the key, or it was revoked"
        with pytest.raises(Unauthorized, match=reason):
            identify(settings, engine, given)


def test_keys_of_the_settings_are_admins_of_the_default_owner(engine: Engine, tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, keys="one,twö")
    with writing(engine) as c:
        key = api_keys.create(c, "lab", "alice", "write")
    assert identify(settings, engine, "one") == identify(settings, engine, "twö") == ADMIN
    assert identify(settings, engine, key) == Caller("alice", "write", number=1)
    for given in (None, "", "three", "one,twö"):
        with pytest.raises(Unauthorized):
            identify(settings, engine, given)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])
def test_service_without_keys_must_listen_on_loopback(host: str, engine: Engine, tmp_path: Path) -> None:
    with pytest.raises(
        InvalidInput, match=r"`envmatte keys make NAME`, set ENVMATTE_KEYS .* or listen on 127"
    ):
        require_keys_unless_loopback(Settings(data=tmp_path, host=host), engine)
    require_keys_unless_loopback(Settings(data=tmp_path, host=host, keys="a-key"), engine)
    with writing(engine) as c:
        api_keys.create(c, "lab", "alice", "read")
        api_keys.revoke(c, "lab")
    require_keys_unless_loopback(Settings(data=tmp_path, host=host), engine)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_no_key(host: str, engine: Engine, tmp_path: Path) -> None:
    require_keys_unless_loopback(Settings(data=tmp_path, host=host), engine)


def test_each_scope_includes_the_smaller_ones() -> None:
    allowed = {
        scope: [other for other in api_keys.SCOPES if Caller("o", scope).may(other)]
        for scope in api_keys.SCOPES
    }
    assert allowed == {"read": ["read"], "write": ["read", "write"], "admin": ["read", "write", "admin"]}
