"""Requests that once caused an internal error."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzzing import requests
from tests.fuzzing.campaign import KEPT, Refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    made = tmp_path_factory.mktemp("service")
    yield made
    requests.served(made / KEPT).close()


def ask(folder: Path, line: str, *headers: str, body: bytes = b"") -> None:
    head = (f"{line} HTTP/1.1", "Host: localhost", f"Content-Length: {len(body)}", *headers, "", "")
    requests.read("\r\n".join(head).encode() + body, folder)


def test_numbers_too_large_for_the_database(folder: Path) -> None:
    ask(folder, f"GET /v1/jobs/v/log?after={2**63 - 1}")
    with pytest.raises(Refused):
        ask(folder, f"GET /v1/jobs/v/log?after={2**63}")


def test_ranges_with_more_digits_than_python_parses(folder: Path) -> None:
    ask(folder, "GET /v1/jobs/v/video.mp4", f"Range: bytes={'9' * 5000}-")
    ask(folder, "GET /v1/jobs/v/video.mp4", f"Range: bytes=-{'9' * 5000}")


@pytest.mark.parametrize("distance", ["inf", "nan", "1e300", "1e-300"])
def test_distances_that_overflow(folder: Path, distance: str) -> None:
    call = "POST /v1/mattes/m/composite?depth=3&distance=2&other=m&other_distance"
    ask(folder, f"{call}=4", body=requests.PNG)
    with pytest.raises(Refused):
        ask(folder, f"{call}={distance}", body=requests.PNG)
