"""Simultaneous requests for one upload: one of them writes, and nothing is damaged."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import select

from storage.database.engine import open_engine, reading
from storage.database.tables import bodies
from tests.end_to_end.captures.tus import (
    TUS,
    begin_patch,
    create,
    offset_of,
    patch,
    uploads_of,
    wait_until_deleted,
)
from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until

pytestmark = pytest.mark.slow


def wait_for_writer(service: Service, where: str) -> None:
    """Wait until a request has begun to write an upload."""
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    query = select(bodies.c.id).where(bodies.c.upload == where.rsplit("/", 1)[1])

    def has_writer() -> bool:
        with reading(engine) as c:
            return c.scalar(query) is not None

    until(has_writer)
    engine.dispose()


def test_request_continues_an_upload_whose_writer_fell_silent(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    silent = begin_patch(service, where, 0, 1000, b"a" * 300)
    wait_for_writer(service, where)
    answer = patch(service, where, 0, b"b" * 1000)
    assert check_problem(answer, 409, "conflict")["offset"] == 300  # what has come is kept
    assert silent.getresponse().status == 409
    assert patch(service, where, 300, b"b" * 700).status_code == 204
    silent.close()
    store = service.data / "store"
    parts = sorted((store / name).read_bytes() for name in uploads_of(service) - before)
    assert parts == [b"a" * 300, b"b" * 700]
    service.http.delete(where, headers=TUS)


def test_request_does_not_interrupt_the_writer_of_an_upload(service: Service) -> None:
    where = create(service, 10_000)
    writer = begin_patch(service, where, 0, 10_000, b"a" * 1000)
    wait_for_writer(service, where)
    with ThreadPoolExecutor() as pool:
        other = pool.submit(patch, service, where, 0, b"b" * 10_000)
        for pause in [1] * 8 + [4]:  # the last when the other has given up
            time.sleep(pause)
            writer.send(b"a" * 1000)
        assert check_problem(other.result(), 409, "conflict")
    assert writer.getresponse().status == 204
    writer.close()
    assert offset_of(service, where) == 10_000
    service.http.delete(where, headers=TUS)


def test_two_clients_with_the_same_key_share_an_upload(
    service: Service, capture_archive: Path, tmp_path: Path
) -> None:
    file = tmp_path / "same.zip"
    file.write_bytes(capture_archive.read_bytes())
    with ThreadPoolExecutor() as pool:
        made = [*pool.map(lambda _: service.client.upload(file), range(2))]
    # One or two captures: the slower client may finish after the first capture exists.
    for capture in made:
        assert service.client.wait(capture["job"])["state"] == "succeeded"
        wait_until_deleted(service, capture["id"])
    assert service.client.upload(file)["id"] not in {capture["id"] for capture in made}


def test_simultaneous_requests_make_one_capture(service: Service, capture_archive: Path) -> None:
    data = capture_archive.read_bytes()
    where = create(service, len(data))
    patch(service, where, 0, data)
    body = {"upload": where.rsplit("/", 1)[1]}
    with ThreadPoolExecutor() as pool:
        answers = [*pool.map(lambda _: service.http.post("/v1/captures", json=body), range(8))]
    assert {answer.status_code for answer in answers} == {201}
    assert {answer.json()["job"] for answer in answers} == {answers[0].json()["job"]}
    assert service.client.wait(answers[0].json()["job"])["state"] == "succeeded"
