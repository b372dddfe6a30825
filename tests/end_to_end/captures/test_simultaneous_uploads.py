"""Simultaneous requests for one upload: one of them wins, and nothing is damaged."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.end_to_end.captures.tus import (
    TUS,
    begin_patch,
    create,
    offset_of,
    patch,
    uploads_of,
    wait_until_deleted,
)
from tests.end_to_end.conftest import Service, paused

pytestmark = pytest.mark.slow


def test_one_of_two_patches_at_the_same_offset_wins(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    first = begin_patch(service, where, 0, 1000, b"a" * 300)
    second = begin_patch(service, where, 0, 1000, b"b" * 300)
    second.send(b"b" * 700)
    assert second.getresponse().status == 204
    first.send(b"a" * 700)
    assert first.getresponse().status == 409
    first.close()
    second.close()
    assert offset_of(service, where) == 1000
    (part,) = uploads_of(service) - before
    assert (service.data / "store" / part).read_bytes() == b"b" * 1000
    service.http.delete(where, headers=TUS)


def test_late_patch_damages_nothing(service: Service, capture_archive: Path) -> None:
    data = capture_archive.read_bytes()
    where = create(service, len(data))
    late = begin_patch(service, where, 0, len(data), bytes(1000))
    assert patch(service, where, 0, data).status_code == 204
    with paused(service):
        made = service.http.post("/v1/captures", json={"upload": where.rsplit("/", 1)[1]}).json()
        late.send(bytes(len(data) - 1000))
        # 409 if the server looked at the late request only when the other had been read.
        assert late.getresponse().status in (404, 409)
        late.close()
    assert service.client.wait(made["job"])["state"] == "succeeded"


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
