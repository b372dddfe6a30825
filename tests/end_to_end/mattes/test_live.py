"""The data from which a browser draws a matte live."""

import json

from tests.end_to_end.conftest import HEIGHT, WIDTH, Service

PROBLEM = "application/problem+json"


def test_live_data_is_made_once(service: Service, matte: str) -> None:
    first = service.http.get(f"/v1/mattes/{matte}/live")
    assert (first.status_code, first.headers["content-encoding"]) == (200, "gzip")
    start = 4 + int.from_bytes(first.content[:4], "little")
    header = json.loads(first.content[4:start])
    assert (header["width"], header["height"], header["step"]) == (WIDTH, HEIGHT, 1)
    assert len(first.content) - start == WIDTH * HEIGHT * (8 * header["lookups"] + 7)
    assert (service.data / "store" / "mattes" / matte / "live-1" / "zarr.json").exists()
    again = service.http.get(f"/v1/mattes/{matte}/live")
    assert again.content == first.content
    known = {"If-None-Match": first.headers["etag"]}
    assert service.http.get(f"/v1/mattes/{matte}/live", headers=known).status_code == 304


def test_unknown_matte_has_no_live_data(service: Service) -> None:
    answer = service.http.get("/v1/mattes/nothing/live")
    assert (answer.status_code, answer.headers["content-type"]) == (404, PROBLEM)


def test_archive_does_not_depend_on_live_data(service: Service, matte: str) -> None:
    service.http.get(f"/v1/mattes/{matte}/live")
    archive = service.http.get(f"/v1/mattes/{matte}/archive").content
    made = service.http.post("/v1/mattes", content=archive, headers={"Content-Type": "application/zip"})
    assert made.status_code == 201
    copy = made.json()["id"]
    answers = [service.http.get(f"/v1/mattes/{one}/live").content for one in (matte, copy)]
    assert answers[0] == answers[1]
    assert service.http.delete(f"/v1/mattes/{copy}").status_code == 204
    assert not (service.data / "store" / "mattes" / copy).exists()
