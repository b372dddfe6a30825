"""Files of the web app over HTTP: smaller than their sources, asked for again each time, and answered by 304."""

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from services.api.system import minified
from services.api.system.pages import WEB

FILES = ["app/main.js", "app/style.css", "app/icon.svg", "play/play.js"]


@pytest.fixture
def http(build: Callable[..., FastAPI]) -> TestClient:
    return TestClient(build(), "http://localhost")


@pytest.mark.parametrize("name", FILES)
def test_files_are_sent_smaller_and_only_if_they_changed(http: TestClient, name: str) -> None:
    pytest.importorskip("minify", reason="there are wheels of the minifier for Linux only")
    answer = http.get(f"/web/{name}")
    assert 0 < len(answer.content) < (WEB / name).stat().st_size
    assert answer.headers["content-type"].partition(";")[0] == minified.TYPES[Path(name).suffix]
    assert answer.headers["cache-control"] == "no-cache"
    tag = answer.headers["etag"]
    assert http.get(f"/web/{name}", headers={"If-None-Match": tag}).status_code == 304
    assert http.get(f"/web/{name}", headers={"If-None-Match": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    ("accepted", "packed"),
    [("gzip", True), ("br, GZIP;q=0.5", True), ("gzip;q=0", False), ("gzip ; q=0.00, *", False), ("", False)],
)
def test_files_are_compressed_for_who_accepts_it(http: TestClient, accepted: str, packed: bool) -> None:
    for name in ("app/main.js", "swagger/swagger-ui.css"):
        answer = http.get(f"/web/{name}", headers={"Accept-Encoding": accepted})
        assert ("content-encoding" in answer.headers, answer.headers["vary"]) == (packed, "Accept-Encoding")
        # One tag for both forms, so it is a weak one.
        assert answer.headers["etag"].startswith('W/"')
        known = {"Accept-Encoding": accepted, "If-None-Match": answer.headers["etag"]}
        again = http.get(f"/web/{name}", headers=known)
        assert (again.status_code, again.headers["etag"]) == (304, answer.headers["etag"])


def test_changed_file_is_sent_again(tmp_path: Path) -> None:
    path = tmp_path / "one.js"
    path.write_text("export const one = 1;\n")
    first = minified.minified_file(path, 1.0)
    path.write_text("export const two = 2;\n")
    assert minified.minified_file(path, 1.0) == first
    content, tag = minified.minified_file(path, 2.0)
    assert b"two" in content
    assert tag != first[1]


def test_files_are_sent_as_they_are_without_the_minifier(
    http: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(minified, "minify", None)
    minified.minified_file.cache_clear()
    try:
        for name in FILES:
            assert http.get(f"/web/{name}").content == (WEB / name).read_bytes()
    finally:
        minified.minified_file.cache_clear()
