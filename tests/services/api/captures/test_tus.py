"""Headers of tus: what an upload's file is called."""

import base64

import pytest

from services.api.captures.tus import file_name


@pytest.mark.parametrize(
    ("sent", "name"),
    [
        ("glass ball.zip", "glass ball"),
        ("a/b.zip", "b"),
        ("a\0b\r\n\x1b[2J.zip", "ab[2J"),
        ("\x85.zip", ".zip"),
        ("x" * 300, "x" * 200),
        ("", ""),
    ],
)
def test_capture_is_named_after_its_file(sent: str, name: str) -> None:
    assert file_name(f"filename {base64.b64encode(sent.encode()).decode()}") == name
