"""Uploads: what counts of them is in the database, and their parts read as one file."""

import io
import threading
import time

import numpy as np
import pytest
from sqlalchemy import Engine, select
from sqlalchemy.exc import IntegrityError

from storage.database.engine import writing
from storage.database.tables import upload_parts
from storage.errors import Conflict, Corrupt, NoRoom, NotFound
from storage.layout import uploads as stored_uploads
from storage.layout.uploads import Part
from storage.objects.store import Objects
from storage.records import uploads

DAY = 86400.0


def made(engine: Engine, upload: str = "u", length: int = 10, seconds: float = DAY) -> str:
    with writing(engine) as c:
        uploads.add(c, upload, length, "name YQ==", seconds, None)
    return upload


def stored(objects: Objects, upload: str, pieces: list[bytes]) -> list[Part]:
    parts = [Part(f"p{n}", len(piece)) for n, piece in enumerate(pieces)]
    for part, piece in zip(parts, pieces, strict=True):
        objects.put(stored_uploads.part_path(upload, part.name), piece)
    return parts


def test_an_upload_advances_by_what_is_written_down(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        before = uploads.get(c, "u")
        assert (before.offset, before.length, before.metadata, before.parts) == (0, 10, "name YQ==", 0)
        assert uploads.advance(c, "u", 0, [Part("a", 3), Part("b", 4)], 2 * DAY) == 7
        assert uploads.advance(c, "u", 7, [], 2 * DAY) == 7
        after = uploads.get(c, "u")
        assert (after.offset, after.parts) == (7, 2)
        assert after.expires_at > before.expires_at + DAY / 2
        assert uploads.advance(c, "u", 7, [Part("c", 3)], DAY) == 10
        assert uploads.parts_of(c, "u") == [Part("a", 3), Part("b", 4), Part("c", 3)]


@pytest.mark.parametrize("offset", [1, 6, 8])
def test_it_advances_from_where_it_stands_alone(engine: Engine, offset: int) -> None:
    made(engine)
    with writing(engine) as c:
        uploads.advance(c, "u", 0, [Part("a", 7)], DAY)
    with pytest.raises(Conflict, match=f"byte 7, not {offset}") as caught, writing(engine) as c:
        uploads.advance(c, "u", offset, [Part("x", 2)], DAY)
    assert caught.value.fields == {"offset": 7}
    with engine.connect() as c:
        assert uploads.parts_of(c, "u") == [Part("a", 7)]


def test_of_many_writers_at_one_offset_one_wins(engine: Engine) -> None:
    made(engine)
    won: list[str] = []
    lost: list[str] = []

    def write(name: str) -> None:
        try:
            with writing(engine) as c:
                uploads.advance(c, "u", 0, [Part(name, 5)], DAY)
            won.append(name)
        except Conflict:
            lost.append(name)

    writers = [threading.Thread(target=write, args=(f"w{n}",)) for n in range(8)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert (len(won), len(lost)) == (1, 7)
    with engine.connect() as c:
        assert uploads.parts_of(c, "u") == [Part(won[0], 5)]


def test_one_that_is_gone_is_not_found(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        uploads.advance(c, "u", 0, [Part("a", 7)], DAY)
        assert uploads.delete(c, "u")
        assert not uploads.delete(c, "u")
        assert c.execute(select(upload_parts)).all() == []
        for call in (
            lambda: uploads.get(c, "u"),
            lambda: uploads.advance(c, "u", 7, [Part("b", 1)], DAY),
        ):
            with pytest.raises(NotFound, match="start a new upload"):
                call()


def test_one_whose_time_is_over_is_gone(engine: Engine) -> None:
    made(engine, "short", seconds=0.05)
    made(engine, "long")
    time.sleep(0.1)
    with writing(engine) as c:
        with pytest.raises(NotFound):
            uploads.get(c, "short")
        assert uploads.delete_expired(c) == ["short"]
        assert uploads.delete_expired(c) == []
        assert uploads.get(c, "long").id == "long"


def test_there_is_one_for_a_key(engine: Engine) -> None:
    with writing(engine) as c:
        uploads.add(c, "first", 1, "", DAY, "key")
        row = uploads.by_key(c, "key")
        assert row is not None
        assert row.id == "first"
        assert uploads.by_key(c, "another") is None
    with pytest.raises(IntegrityError), writing(engine) as c:
        uploads.add(c, "second", 1, "", DAY, "key")
    with writing(engine) as c:
        uploads.delete(c, "first")
        uploads.add(c, "second", 1, "", DAY, "key")


def test_room_counts_what_is_promised(engine: Engine, objects: Objects) -> None:
    free = objects.free_bytes()
    if free is None:  # a bucket has no end
        with engine.connect() as c:
            uploads.check_room(c, objects, 1 << 60)
        return
    with writing(engine) as c:
        uploads.check_room(c, objects, free // 2)
        with pytest.raises(NoRoom, match="Delete captures") as caught:
            uploads.check_room(c, objects, 2 * free)
        assert abs(int(caught.value.fields["missing"]) - free) < free // 10
        uploads.add(c, "u", free, "", DAY, None)
        with pytest.raises(NoRoom):
            uploads.check_room(c, objects, free // 2)
        uploads.advance(c, "u", 0, [Part("a", free)], DAY)
        uploads.check_room(c, objects, free // 2)


@pytest.mark.parametrize("sizes", [[], [0], [1], [5, 1, 70_000, 200_000, 3], [1 << 20, 1 << 17]])
def test_parts_read_as_one_file(objects: Objects, sizes: list[int]) -> None:
    rng = np.random.default_rng(1)
    pieces = [rng.bytes(size) for size in sizes]
    whole = b"".join(pieces)
    stored_uploads.seal(objects, "u", stored(objects, "u", pieces))
    with stored_uploads.read(objects, "u") as file:
        assert file.read() == whole
        assert file.read(5) == b""
        twin = io.BytesIO(whole)
        for _ in range(200):
            at, count = (int(n) for n in rng.integers(0, len(whole) + 10, 2))
            assert file.seek(at) == twin.seek(at)
            assert file.read(count) == twin.read(count)
        assert file.seek(-len(whole), io.SEEK_END) == 0
        assert (file.seek(2, io.SEEK_CUR), file.tell()) == (2, 2)
        with pytest.raises(ValueError, match="before the start"):
            file.seek(-len(whole) - 1, io.SEEK_END)


def test_a_missing_part_is_told_before_anything_is_read(objects: Objects) -> None:
    with pytest.raises(FileNotFoundError):
        stored_uploads.read(objects, "u")
    stored_uploads.seal(objects, "u", stored(objects, "u", [b"one", b"two"]))
    objects.delete(stored_uploads.part_path("u", "p1"))
    with pytest.raises(FileNotFoundError, match="p1"):
        stored_uploads.read(objects, "u")


def test_a_part_that_is_cut_short_is_damage(objects: Objects) -> None:
    stored_uploads.seal(objects, "u", stored(objects, "u", [b"one", b"two"]))
    objects.put(stored_uploads.part_path("u", "p0"), b"on")
    with stored_uploads.read(objects, "u") as file, pytest.raises(Corrupt, match=r"p0\.part is shorter"):
        file.read()


def test_what_killed_writers_left_is_swept(objects: Objects) -> None:
    parts = stored(objects, "u", [b"one", b"two", b"three"])
    stored_uploads.sweep(objects, "u", [part.name for part in parts[:2]])
    assert objects.names("uploads/u") == ["p0.part", "p1.part"]
    stored_uploads.sweep(objects, "u", [])
    assert objects.names("uploads/u") == []


def test_removing_it_removes_all_of_it(objects: Objects) -> None:
    stored_uploads.seal(objects, "u", stored(objects, "u", [b"one"]))
    stored(objects, "v", [b"another's"])
    stored_uploads.remove(objects, "u")
    stored_uploads.remove(objects, "u")
    assert objects.names("uploads") == ["v"]
