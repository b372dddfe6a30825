"""Entity tags, as clients and proxies send them back."""

import pytest
from starlette.datastructures import Headers

from services.api.http.responses import etag_matches


@pytest.mark.parametrize(
    ("known", "matches"),
    [
        ('"abc"', True),
        ('W/"abc"', True),
        ('"other", W/"abc"', True),
        ("*", True),
        (" * ", True),
        ('"other"', False),
        ('W/"other"', False),
        ("abc", False),
        ('w/"abc"', False),
        ("", False),
    ],
)
def test_tags_are_compared_weakly(known: str, matches: bool) -> None:
    assert etag_matches(Headers({"If-None-Match": known}), '"abc"') == matches


def test_without_the_header_nothing_is_known() -> None:
    assert not etag_matches(Headers(), '"abc"')
