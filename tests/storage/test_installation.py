"""By what an installation recognises its store."""

import threading
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage import installation
from storage.database.engine import reading, writing
from storage.errors import WrongStore
from storage.objects import marker
from storage.objects.store import Objects
from storage.records import mattes
from tests.storage.installation import fill


def test_the_first_start_marks_the_store_and_later_ones_recognise_it(
    engine: Engine, objects: Objects, tmp_path: Path
) -> None:
    id = installation.recognise(engine, objects)
    assert marker.read(objects) == id
    assert installation.recognise(engine, objects) == id
    elsewhere = Objects((tmp_path / "elsewhere").as_uri())
    with pytest.raises(WrongStore, match="does not see the store of this installation"):
        installation.recognise(engine, elsewhere)
    assert elsewhere.names("") == []
    marker.write(elsewhere, "another")
    with pytest.raises(WrongStore):
        installation.recognise(engine, elsewhere)


def test_a_marked_store_keeps_its_mark_with_a_new_database(engine: Engine, objects: Objects) -> None:
    marker.write(objects, "before")
    assert installation.recognise(engine, objects) == "before"
    assert marker.read(objects) == "before"


def test_services_that_start_at_once_agree(engine: Engine, objects: Objects) -> None:
    found: list[str] = []
    threads = [
        threading.Thread(target=lambda: found.append(installation.recognise(engine, objects)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with reading(engine) as c:
        assert found == [installation.find(c)] * 4
    assert marker.read(objects) == found[0]


def test_a_store_that_is_away_is_not_waited_for(engine: Engine, s3: str) -> None:
    id = installation.recognise(engine, Objects(s3))
    assert installation.recognise(engine, Objects(s3.replace("envmatte", "another"))) == id


def test_an_empty_store_is_not_that_of_a_database_with_captures(
    engine: Engine, objects: Objects, tmp_path: Path
) -> None:
    fill(engine, objects)
    unmounted = Objects((tmp_path / "unmounted").as_uri())
    with pytest.raises(WrongStore, match="the store is empty"):
        installation.recognise(engine, unmounted)
    assert unmounted.names("") == []
    # An earlier version did not mark its store.
    id = installation.recognise(engine, objects)
    assert marker.read(objects) == id


@pytest.mark.parametrize("mark", [True, False])
def test_a_store_is_not_that_of_a_database_that_knows_nothing_of_it(
    mark: bool, engine: Engine, objects: Objects
) -> None:
    """As when a new service is pointed at the store of another one: its sweep would remove all."""
    for path in ("mattes/theirs/S/c/0", "installation"):
        objects.put(path, b"theirs")
        with pytest.raises(WrongStore, match="the database knows none of them"):
            installation.recognise(engine, objects, mark=mark)
    with writing(engine) as c:
        mattes.add(c, "theirs", "c", "r", {})
    assert installation.recognise(engine, objects) == "theirs"


def test_an_api_alone_marks_no_store(engine: Engine, objects: Objects) -> None:
    assert installation.recognise(engine, objects, mark=False) is None
    assert objects.names("") == []
    id = installation.recognise(engine, objects)
    assert installation.recognise(engine, objects, mark=False) == id
