"""Jobs followed by server-sent events."""

import json
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from urllib.parse import urlsplit

import httpx2

from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem


def events(answer: httpx2.Response) -> Iterator[tuple[str, dict]]:
    """Ids and data of the events as they arrive."""
    id, data = "", ""
    for line in answer.iter_lines():
        name, _, value = line.partition(": ")
        if name == "id":
            id = value
        elif name == "data":
            data += value
        elif not line and data:
            yield id, json.loads(data)
            id, data = "", ""


def followed(service: Service, job: str, last: str | None = None) -> list[tuple[str, dict]]:
    headers = {"Last-Event-ID": last} if last else {}
    with service.http.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        return list(events(answer))


def test_events_follow_a_job_to_its_end(service: Service, capture: str) -> None:
    job = service.client.recover(capture, tile=16)["id"]
    found = followed(service, job)
    states = [data["state"] for _, data in found]
    assert states[-1] == "succeeded"
    assert "running" in states
    assert [data["progress"] for _, data in found] == sorted(data["progress"] for _, data in found)
    assert found[-1][1] | {"run_seconds": 0} == service.client.job(job).answer | {"run_seconds": 0}
    ids = [id for id, _ in found]
    assert len(set(ids)) == len(ids)
    # A client that reconnects gets what is new: the end, or nothing and a signal to stop.
    assert followed(service, job, ids[0])[-1] == found[-1]
    assert service.http.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": ids[-1]}).status_code == 204


def test_events_end_when_the_job_is_cancelled_or_deleted(service: Service, capture: str) -> None:
    job = service.client.recover(capture)["id"]
    with service.http.stream("GET", f"/v1/jobs/{job}/events") as answer:
        received = events(answer)
        next(received)
        service.client.cancel(job)
        assert [data["state"] for _, data in received][-1] == "cancelled"
    assert service.http.delete(f"/v1/jobs/{job}").status_code == 204
    check_problem(service.http.get(f"/v1/jobs/{job}/events"), 404, "not-found")


def test_head_of_a_stream_leaves_the_connection_free(service: Service) -> None:
    program = service.http.post("/v1/programs", json={"preset": "sketch"}).json()["id"]
    connection = HTTPConnection(urlsplit(service.url).netloc, timeout=10)
    with closing(connection):
        connection.request("HEAD", f"/v1/programs/{program}/events")
        head = connection.getresponse()
        assert (head.status, head.read()) == (200, b"")
        connection.request("GET", f"/v1/programs/{program}/events")
        answer = connection.getresponse()
        assert answer.getheader("content-type") == head.getheader("content-type")
        assert answer.readline()
