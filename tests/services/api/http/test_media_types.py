"""Content-Type and Accept, as clients write them."""

import pytest
from starlette.requests import Request

from services.api.http.media_types import media_type_of, preferred, require_media_type
from services.runtime.problems import WrongMediaType

OFFERED = ("image/png", "image/jpeg", "image/x-exr")


def request(content_type: str | None) -> Request:
    headers = [] if content_type is None else [(b"content-type", content_type.encode())]
    return Request({"type": "http", "headers": headers})


@pytest.mark.parametrize(
    ("content_type", "media_type"),
    [
        ("application/zip", "application/zip"),
        (" Application/ZIP ; charset=x", "application/zip"),
        ("", ""),
        (None, ""),
    ],
)
def test_media_type_is_lower_case_without_parameters(content_type: str | None, media_type: str) -> None:
    assert media_type_of(request(content_type)) == media_type


def test_wrong_media_type_is_refused_with_the_right_one() -> None:
    require_media_type(request("application/zip"), "application/zip", "an archive")
    with pytest.raises(WrongMediaType, match="send an archive as application/zip, not as text/plain"):
        require_media_type(request("text/plain"), "application/zip", "an archive")
    with pytest.raises(WrongMediaType, match="not as nothing"):
        require_media_type(request(None), "application/zip", "an archive")


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        ("*/*", "image/png"),
        ("image/*", "image/png"),
        ("text/html, image/jpeg", "image/jpeg"),
        ("image/jpeg;q=0.5, image/x-exr", "image/x-exr"),
        ("image/jpeg;q=0.5, */*;q=0.1", "image/jpeg"),
        ("image/jpeg, image/png", "image/jpeg"),
        ("IMAGE/JPEG; q=1", "image/jpeg"),
        ("image/jpeg;q=x, image/x-exr", "image/x-exr"),
        ("image/jpeg;q=0", None),
        ("image/png;q=0, */*", "image/jpeg"),
        ("*/*, image/png;q=0", "image/jpeg"),
        ("image/*;q=0.5, image/png;q=0.1", "image/jpeg"),
        ("*/*;q=0.9, image/*;q=0, image/x-exr;q=0.2", "image/x-exr"),
        ("image/*;q=0, */*", None),
        ("image/x-exr;q=nan, image/jpeg;q=0.1", "image/jpeg"),
        ("image/x-exr;q=1e9, image/jpeg;q=0.1", "image/jpeg"),
        ("image/x-exr;q=-1", None),
        ("image/jpeg;q=0.8, image/x-exr;q=0.8", "image/jpeg"),
        ("text/html,image/webp,*/*;q=0.8", "image/png"),
        ("text/html", None),
        ("text/*", None),
        ("", None),
    ],
)
def test_best_offered_media_type_is_chosen(accept: str, media_type: str | None) -> None:
    assert preferred(accept, OFFERED) == media_type
