"""Jobs that are paused and continued, and parts of a frame that are recovered first, on a real server."""

import time

from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, paused
from tests.end_to_end.mattes.test_composites import post_composite
from tests.parts.waiting import until
from workflows.images import integer_formats

REGION = (WIDTH - 12, HEIGHT - 12, 10, 10)
"""Within the last tile of 16 x 16 pixels."""


def test_paused_job_does_nothing_until_it_is_continued(service: Service, capture: str) -> None:
    job = service.client.recover(capture, quality="fast", tile=16)
    found = service.client.pause(job)
    assert found.answer["paused"] is True
    assert found.waits_for == "it is paused, and does what is left once it is continued"
    time.sleep(2)  # for what the service knows of the cluster, and to write what is done
    until(lambda: service.http.get("/v1/cluster").json()["queue"]["tiles_under_way"] == 0)
    rest = service.client.job(job)
    assert rest.tiles["total"] == 0 or rest.tiles["done"] < rest.tiles["total"]
    time.sleep(4)  # in which all tiles would be done
    later = service.client.job(job)
    assert later.eta_seconds is None
    assert later.tiles == rest.tiles
    assert service.client.resume(job).answer["paused"] is False
    after = service.client.wait(job)
    assert after.tiles["done"] == after.tiles["total"]
    log = [line["text"] for line in service.http.get(f"/v1/jobs/{job.id}/log").json()["lines"]]
    assert [text for text in log if text in ("paused", "continued")] == ["paused", "continued"]
    assert service.http.patch(f"/v1/jobs/{job.id}", json={"paused": True}).status_code == 409


def test_region_is_recovered_first(service: Service, capture: str) -> None:
    with paused(service):  # so that all tiles are ordered before the first is done
        # A method slow enough that tiles are left when the job is paused.
        job = service.client.recover(capture, region=REGION, method="nn-dgsr", tile=16)
    x, y, width, height = REGION

    def recovered() -> bool:
        if not service.client.job(job).tiles["done"]:
            return False
        pixels = integer_formats.decode(
            post_composite(service, job.matte or "").content, memory=1 << 24, alpha=True
        )
        return bool(pixels[y : y + height, x : x + width, 3].min() == 255)

    until(recovered)
    service.client.pause(job)
    picture = post_composite(service, job.matte or "")
    assert float(picture.headers["envmatte-recovered"]) < 1
    other = (0, 0, 8, 8)
    assert service.client.recover_first(job, other).answer["region"] == dict(
        zip(("x", "y", "width", "height"), other, strict=True)
    )
    service.client.cancel(job)


def test_job_without_tiles_of_a_frame_takes_no_region(service: Service, capture: str) -> None:
    region = {"x": 0, "y": 0, "width": 8, "height": 8}
    ingest = service.client.capture(capture).job
    # It has ended.
    assert service.http.patch(f"/v1/jobs/{ingest}", json={"region": region}).status_code == 409
    job = service.client.recover(capture, quality="fast")
    for wrong in ({"region": region | {"width": 0}}, {"region": [0, 0, 8, 8]}, {"state": "failed"}):
        answer = service.http.patch(f"/v1/jobs/{job.id}", json=wrong)
        assert answer.status_code == 422, wrong
    service.client.wait(job)
