"""What an Idempotency-Key has created."""

from sqlalchemy import Connection

from storage.records import idempotency


def test_find_what_a_key_created(connection: Connection) -> None:
    assert idempotency.find(connection, "key", "POST /v1/jobs") is None
    idempotency.add(connection, "key", "POST /v1/jobs", "abc")
    assert idempotency.find(connection, "key", "POST /v1/jobs") == "abc"
    assert idempotency.find(connection, "key", "POST /v1/captures") is None
    assert idempotency.find(connection, "other", "POST /v1/jobs") is None
