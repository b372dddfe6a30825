"""capture.json: malformed text is refused with the field at fault, and the JSON Schema agrees with the parser."""

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from pydantic import ValidationError

from storage.errors import CaptureError
from workflows.ingest.manifest import EXAMPLE, Manifest, parse_manifest

MANIFEST: dict[str, Any] = {
    "format": "envmatte-capture/1",
    "program": {
        "monitor": {"width": 64, "height": 48, "response": {"gamma": 2.2}},
        "parts": [
            {"kind": "constant", "levels": [0, 1]},
            {"kind": "constant", "colours": [[0, 0, 0], [1, 0, 0.5]]},
            {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 2, "seed": 1, "offset": True},
            {"kind": "stripes", "axis": "x", "count": 2},
            {"kind": "images", "files": ["a.png"]},
        ],
    },
    "frames": [{"file": f"{n}.png", "pattern": n, "exposure": 0.5} for n in range(9)],
}
VIDEO = {"file": "film.mp4", "patterns_per_second": 2.0, "border": {"width": 480, "height": 360}}
SCHEMA = Manifest.model_json_schema()


def refused(text: bytes) -> CaptureError:
    with pytest.raises(CaptureError) as caught:
        parse_manifest(text)
    assert caught.value.detail
    assert caught.value.fields["entry"] == "capture.json"
    return caught.value


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"format": "envmatte-capture/1",}',
        b"\0" * 50,
    ],
)
def test_malformed_text_is_refused(text: bytes) -> None:
    refused(text)


@pytest.mark.parametrize(
    ("change", "field", "reason"),
    [
        (lambda r: r.update(response={"gamma": 99}), "response.gamma", "must be at most 5"),
        (
            lambda r: r["program"]["parts"][3].update(count=99),
            "program.parts.3.count",
            "must be at most 14",
        ),
        (
            lambda r: r["program"]["parts"].append({"kind": "halftone", "levels": [0.3]}),
            f"program.parts.{len(MANIFEST['program']['parts'])}.levels.0",
            "multiple of 0.25",
        ),
    ],
)
def test_error_names_the_field_and_its_range(
    change: Callable[[dict[str, Any]], object], field: str, reason: str
) -> None:
    manifest = copy.deepcopy(MANIFEST)
    change(manifest)
    error = refused(json.dumps(manifest).encode())
    assert error.fields == {"entry": "capture.json", "field": field}
    assert reason in error.detail


@pytest.mark.parametrize(
    "path", ["frames", "program.parts", "program.parts.0.levels", "program.parts.0.colours"]
)
def test_only_the_first_of_many_errors_is_collected(path: str) -> None:
    manifest = copy.deepcopy(MANIFEST)
    inner: Any = manifest
    *names, last = (int(name) if name.isdigit() else name for name in path.split("."))
    for name in names:
        inner = inner[name]
    inner[last] = [{}] * 1000
    error = refused(json.dumps(manifest).encode())
    assert str(error.fields["field"]).startswith(f"{path}.0")
    assert isinstance(error.__cause__, ValidationError)
    assert error.__cause__.error_count() < 4  # a list of millions takes gigabytes


@pytest.mark.parametrize("piece", [b"[],", b'{"":0},'])
def test_many_empty_objects_and_lists_are_refused(piece: bytes) -> None:
    error = refused(b'{"more": [' + 200_000 * piece + b"0]}")
    assert error.fields == {"entry": "capture.json", "limit": 150_000}


@pytest.mark.parametrize(
    ("change", "valid"),
    [
        (lambda r: None, True),
        (lambda r: r.update(made_by={"tool": "x"}), True),
        (lambda r: r.update(mask=None, video=None), True),
        (lambda r: r.update(frames=[], video=VIDEO), True),
        (lambda r: (r.pop("frames"), r.update(video=VIDEO | {"border": None})), True),
        (lambda r: r["program"]["parts"][0].update(colours=[]), True),
        (lambda r: r["program"]["parts"][2].update(seed=2**64 - 1), True),
        (lambda r: r["program"]["parts"][2].update(seed=2**64), False),
        (lambda r: r["program"]["parts"][0].update(colours=[[0, 0, 0]]), False),
        (lambda r: r["program"]["parts"][1].update(colours=[[0, 0]]), False),
        (lambda r: r["program"]["parts"][0].update(levels=[]), False),
        (lambda r: r["program"]["parts"][0].update(kind="hadamard"), False),
        (lambda r: r["program"]["monitor"].update(response={"gamma": 2.2, "more": 1}), False),
        (lambda r: r["frames"][0].update(exposure=0), False),
        (lambda r: r.update(format="envmatte-capture/2"), False),
        (lambda r: r.update(name="x" * 201), False),
    ],
)
def test_schema_agrees_with_the_parser(change: Callable[[dict[str, Any]], object], valid: bool) -> None:
    manifest = copy.deepcopy(MANIFEST)
    change(manifest)
    assert Draft202012Validator(SCHEMA).is_valid(manifest) == valid
    if valid:
        parse_manifest(json.dumps(manifest).encode())
    else:
        refused(json.dumps(manifest).encode())


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r.update(video=VIDEO),
        lambda r: r.update(frames=[]),
        lambda r: r.pop("frames"),
    ],
)
def test_schema_requires_either_frames_or_a_video(change: Callable[[dict[str, Any]], object]) -> None:
    manifest = copy.deepcopy(MANIFEST)
    change(manifest)
    assert not Draft202012Validator(SCHEMA).is_valid(manifest)


def test_schema_is_valid_and_describes_every_field() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    for model in (SCHEMA, *SCHEMA["$defs"].values()):
        assert model["title"]
        assert model["description"]
        for name, field in model["properties"].items():
            assert field.get("description"), (model["title"], name)


def test_example_in_the_schema_is_a_valid_manifest() -> None:
    assert SCHEMA["examples"] == [EXAMPLE]
    Draft202012Validator(SCHEMA).validate(EXAMPLE)
    manifest = parse_manifest(json.dumps(EXAMPLE).encode())
    assert [frame.pattern for frame in manifest.frames] == list(range(manifest.program.count))


def test_a_byte_order_mark_is_skipped_and_utf_16_is_named() -> None:
    """As Notepad and PowerShell save it."""
    text = json.dumps(EXAMPLE)
    assert parse_manifest(text.encode("utf-8-sig")) == parse_manifest(text.encode())
    for encoding in ("utf-16-le", "utf-16-be"):
        error = refused(f"\ufeff{text}".encode(encoding))
        assert error.detail == "capture.json is in UTF-16: save it in UTF-8"
