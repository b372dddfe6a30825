"""From a clip to a video of the glass in front of it, over HTTP."""

import json
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from services.client import ServiceError
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, serving
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until
from tests.services.cluster.clusters import workers
from tests.workflows.composite.video.test_steps import TICK, clip, even, frames_of, pictures
from workflows.images import integer_formats

VIDEO = {"Content-Type": "video/mp4"}

OPTIONS = {
    "transfer": "srgb",
    "around": "nothing",
    "fit": "monitor",
    "placement": {"right": 0, "down": 0, "scale": 1, "angle": 0},
}


def stored(service: Service) -> set[str]:
    return {name for name in service.stored() if name.startswith("composites")}


def post(service: Service, matte: str, data: bytes, **headers: str) -> dict:
    answer = service.http.post(f"/v1/mattes/{matte}/composite", content=data, headers=VIDEO | headers)
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    return dict(answer.json())


def test_clip_becomes_a_video_with_its_timestamps(service: Service, matte: str) -> None:
    before = stored(service)
    ticks = [3 * n * n for n in range(40)]
    shown = pictures(40)
    data = clip(shown, ticks, crf="4")
    job = post(service, matte, data, **{"Idempotency-Key": "once"})
    assert post(service, matte, data, **{"Idempotency-Key": "once"})["id"] == job["id"]
    of_another = {**VIDEO, "Idempotency-Key": "once"}
    other = service.http.post("/v1/mattes/no-such-id/composite", content=data, headers=of_another)
    check_problem(other, 404, "not-found")
    assert (job["kind"], job["matte"], job["options"]) == ("composite", matte, OPTIONS)
    done = service.client.wait(job["id"])
    assert done["pixels"] == 40 * WIDTH * HEIGHT
    log = service.http.get(f"/v1/jobs/{job['id']}/log").json()["lines"]
    assert any("the clip has 40 frames of 72 x 54 pixels" in line["text"] for line in log)

    video = service.http.get(done["video"])
    assert video.headers["content-type"] == "video/mp4"
    made, times, _ = frames_of(video.content)
    assert times == [tick * TICK for tick in ticks]
    still = service.client.composite(matte, integer_formats.encode_png(shown[20]))
    expected = integer_formats.decode(still, memory=1 << 24)[..., :3].astype(float)
    assert np.sqrt(np.mean((made[20] - expected) ** 2)) < 12

    url, whole = done["video"], video.content
    for requested, span in {"0-9": (0, 10), "100-": (100, None), "-7": (-7, None)}.items():
        part = service.http.get(url, headers={"Range": f"bytes={requested}"})
        assert (part.status_code, part.content) == (206, whole[slice(*span)])
    assert part.headers["content-range"] == f"bytes {len(whole) - 7}-{len(whole) - 1}/{len(whole)}"
    beyond = service.http.get(url, headers={"Range": f"bytes={len(whole)}-"})
    assert beyond.headers["content-range"] == f"bytes */{len(whole)}"
    check_problem(beyond, 416, "bad-range")
    assert service.http.get(url, headers={"Range": "lines=1-2"}).content == whole

    only = f"composites/{job['id']}/video.mp4"
    until(lambda: stored(service) - before == {only})  # the job's inputs are deleted
    assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert stored(service) == before


def test_clip_by_the_command_line(service: Service, matte: str, tmp_path: Path) -> None:
    backdrop, output = tmp_path / "clip", tmp_path / "out.mp4"
    backdrop.write_bytes(clip(pictures(5), even(5)))
    done = envmatte(service, "composite", matte, str(backdrop), "-o", str(output), "--json")
    assert done.returncode == 0, done.stderr
    assert "composite: 100%" in done.stderr
    assert json.loads(done.stdout) == {"output": str(output)}
    assert len(frames_of(output.read_bytes())[0]) == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip", "out.mp4"]


def test_invalid_clip_fails_and_leaves_nothing(service: Service, matte: str) -> None:
    before = stored(service)
    job = post(service, matte, b"no clip" * 99)
    with pytest.raises(ServiceError, match="can't be read as a video") as caught:
        service.client.wait(job["id"])
    assert (caught.value.problem["status"], caught.value.problem["type"]) == (
        422,
        "urn:envmatte:problem:bad-clip",
    )
    until(lambda: stored(service) == before)
    again = service.http.post(f"/v1/jobs/{job['id']}/retry")
    assert (again.status_code, "send another" in again.json()["detail"]) == (409, True)
    assert service.http.get(f"/v1/jobs/{job['id']}/video.mp4").status_code == 409
    assert service.client.matte(matte)["state"] == "ready"


def test_cancelled_clip_releases_its_matte(service: Service, matte: str) -> None:
    before = stored(service)
    job = post(service, matte, clip(pictures(300), even(300)))
    refused = service.http.delete(f"/v1/mattes/{matte}")
    assert (refused.status_code, job["id"] in refused.json()["detail"]) == (409, True)
    service.client.cancel(job["id"])
    until(lambda: stored(service) == before)
    assert service.client.job(job["id"])["state"] == "cancelled"
    assert service.client.matte(matte)["state"] == "ready"


@pytest.mark.exhaustive
def test_kills_change_no_byte_of_a_clip(service: Service, matte: str, tmp_path: Path) -> None:
    data = clip(pictures(450), even(450))
    undisturbed = service.client.wait(post(service, matte, data)["id"])
    assert undisturbed["tiles"]["total"] >= 6
    archive = tmp_path / "matte.zip"
    service.client.export(matte, archive)

    def done(running: Service) -> int:
        return int(running.client.job(job["id"])["tiles"]["done"])

    with serving(tmp_path / "data", "--workers", "1") as first:
        job = post(first, first.client.import_matte(archive)["id"], data)
        until(lambda: done(first) >= 1)
        for worker in workers(first.process):
            worker.kill()
        until(lambda: done(first) >= 3)
        first.kill()
    with serving(tmp_path / "data", "--workers", "1") as second:
        assert 3 <= done(second) < undisturbed["tiles"]["total"]
        ended = second.client.wait(job["id"])
        again = second.http.get(ended["video"]).content
        until(lambda: stored(second) == {f"composites/{job['id']}/video.mp4"})
    assert again == service.http.get(undisturbed["video"]).content


def test_invalid_clip_is_refused_before_its_body(service: Service, matte: str) -> None:
    before = stored(service)
    host = urlsplit(service.url)
    with closing(HTTPConnection(str(host.hostname), host.port, timeout=60)) as connection:
        connection.putrequest("POST", f"/v1/mattes/{matte}/composite")
        for name, value in (VIDEO | {"Content-Length": str(9 << 30)}).items():
            connection.putheader(name, value)
        connection.endheaders()  # and no byte of the body
        refused = connection.getresponse()
        assert (refused.status, json.load(refused)["limit"]) == (413, 8 << 30)
    answer = service.http.post("/v1/mattes/none/composite", headers=VIDEO, content=b"any")
    assert answer.status_code == 404
    assert stored(service) == before
