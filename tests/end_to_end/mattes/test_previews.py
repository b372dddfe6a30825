"""The preview of a large matte, on a real server: all of the glass before most of it is recovered."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.conftest import BANDS, Service, paused
from tests.end_to_end.mattes.test_composites import SENT, decoded, post_composite
from tests.parts.captures import nested_program
from tests.parts.waiting import until
from workflows.images import integer_formats
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

pytestmark = pytest.mark.slow
WIDTH, HEIGHT, SPACING = 432, 352, 4


@pytest.fixture(scope="module")
def large(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    return upload_large(service, tmp_path_factory.mktemp("large") / "ball.zip")


def upload_large(service: Service, path: Path) -> str:
    """Upload a capture whose mattes have a preview, and wait until it is ingested."""
    program = nested_program((640, 480), bands=BANDS, levels=5)
    write_capture(glass_ball(WIDTH, HEIGHT, monitor=(640, 480), rays=1), program, path)
    uploaded = service.client.upload(path)
    service.client.wait(uploaded["job"])
    return str(uploaded["id"])


def live_header(content: bytes) -> dict[str, int]:
    found: dict[str, int] = json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")])
    return found


@pytest.mark.exhaustive
def test_whole_frame_is_served_while_it_is_recovered(service: Service, large: str) -> None:
    job = service.client.recover(large, quality="fast")
    matte = job["matte"]
    until(lambda: service.client.job(job["id"])["stage"] == "recovering")
    with paused(service):
        found = service.http.get(f"/v1/mattes/{matte}").json()
        assert (found["state"], found["preview"], found["width"]) == ("recovering", SPACING, WIDTH)
        sizes = -(-(WIDTH - SPACING // 2) // SPACING), -(-(HEIGHT - SPACING // 2) // SPACING)
        early = post_composite(service, matte)
        crop = post_composite(service, matte, x=100, y=90, width=50, height=40)
        live = service.http.get(f"/v1/mattes/{matte}/live")
        layer = service.http.get(f"/v1/mattes/{matte}/layers/alpha.png")
        again = service.http.get(f"/v1/mattes/{matte}/live", headers={"If-None-Match": live.headers["etag"]})
        for answer in (early, crop, live, layer, again):
            assert float(answer.headers["envmatte-recovered"]) < 1
        assert again.status_code == 304
        header = live_header(live.content)
        assert (header["width"], header["height"]) == sizes
        assert integer_formats.decode(layer.content, memory=1 << 24).shape[:2] == sizes[::-1]
        pixels = integer_formats.decode(early.content, memory=1 << 24, alpha=True)
        assert pixels.shape == (HEIGHT, WIDTH, 3)  # nothing is transparent
        np.testing.assert_array_equal(decoded(crop), pixels[90:130, 100:150, :3])
        for path in ("transport?x=1&y=1", "archive", "live.html"):
            assert service.http.get(f"/v1/mattes/{matte}/{path}").status_code == 409, path
    service.client.wait(job["id"])
    whole = post_composite(service, matte)
    assert whole.headers["envmatte-recovered"] == "1.0000"
    difference = decoded(whole).astype(float) - pixels[..., :3]
    assert np.sqrt(np.mean(difference**2)) < 40  # of 255: the backdrop has edges, and the glass is sharp
    assert service.http.get(f"/v1/mattes/{matte}").json()["preview"] is None
    full = service.http.get(f"/v1/mattes/{matte}/live", headers={"If-None-Match": live.headers["etag"]})
    assert live_header(full.content)["width"] == WIDTH
    assert not (service.data / "store" / "mattes" / matte / "preview").exists()


@pytest.mark.exhaustive
def test_requests_never_fail_while_a_matte_is_completed(service: Service, large: str) -> None:
    job = service.client.recover(large, quality="fast")
    until(lambda: service.client.job(job["id"])["stage"] == "recovering")
    shares = []
    while not shares or shares[-1] < 1:
        answer = post_composite(service, job["matte"], SENT, "image/jpeg", size=100)
        assert answer.status_code == 200, answer.text
        shares.append(float(answer.headers["envmatte-recovered"]))
        live = service.http.get(f"/v1/mattes/{job['matte']}/live")
        assert live.status_code == 200, live.text
    assert shares == sorted(shares)
    service.client.wait(job["id"])
