"""The manifest of a capture archive, capture.json: its models, and how its text is parsed.

`Manifest.model_json_schema()` is published as the JSON Schema of the format, so every field has a description.
"""

import codecs
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError

from storage.errors import CaptureError
from workflows.images.tone_curves import Response
from workflows.programs.border import Border
from workflows.programs.program import Program
from workflows.untrusted.validation import Name, field_and_reason

MANIFEST = "capture.json"
MANIFEST_BYTES = 4 << 20
"""The largest manifest: about 200 bytes for each of `MAX_FRAMES`."""
MANIFEST_NODES = 150_000
"""The most objects and lists in it: an empty one takes 2 bytes of text, but 300 bytes of memory while parsing."""

EXAMPLE: dict[str, Any] = {
    "format": "envmatte-capture/1",
    "name": "glass ball",
    "program": {
        "monitor": {"width": 1280, "height": 960, "response": "linear"},
        "parts": [
            {"kind": "constant", "levels": [0.0, 1.0]},
            {"kind": "bernoulli", "columns": 16, "rows": 12, "count": 2, "seed": 7, "colour": "grey"},
        ],
    },
    "response": "srgb",
    "frames": [{"file": f"frames/{n:05d}.png", "pattern": n} for n in range(4)],
    "mask": "mask.png",
}


class Frame(BaseModel):
    """One frame: an image file in the archive, and the pattern that it shows."""

    model_config = ConfigDict(frozen=True)
    file: str = Field(
        description="Name of the image in the archive: PNG, TIFF, JPEG, HEIC, EXR, Radiance HDR or camera RAW. All "
        "frames have one size and kind.",
        examples=["frames/00000.png"],
    )
    pattern: int = Field(
        ge=0,
        description="Number of the pattern that the frame shows. Patterns are numbered from 0 through the program's "
        "parts, in order.",
        examples=[0],
    )
    exposure: Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)] = Field(
        default=1.0,
        description="Exposure time, in seconds or any other unit. Frames of one pattern with different exposures are "
        "merged into one of higher dynamic range.",
        examples=[0.008],
    )


class Video(BaseModel):
    """A recording of the program, from before its start until after its end; or until now, if it is `unfinished`."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    file: str = Field(
        description="Name of the video in the archive: H.264, HEVC, MJPEG and others, in MP4, MOV, MTS, MKV, WebM or "
        "AVI.",
        examples=["film.mp4"],
    )
    patterns_per_second: float = Field(
        ge=0.01,
        le=120,
        description="About how many patterns the monitor showed in a second. The camera need not be synchronised.",
        examples=[2.0],
    )
    border: Border | None = Field(
        default=None,
        description="The display on which the patterns were shown inside a numbered border; null without a border.",
    )


class Manifest(BaseModel):
    """What a capture archive holds: the program that the monitor showed, and the frames or the video of it."""

    model_config = ConfigDict(
        frozen=True,
        title="envmatte capture (capture.json)",
        json_schema_extra={
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "oneOf": [
                {"required": ["frames"], "properties": {"frames": {"minItems": 1}}},
                {"required": ["video"], "properties": {"video": {"type": "object"}}},
            ],
            "examples": [EXAMPLE],
        },
    )
    format: Literal["envmatte-capture/1"] = Field(description="Name and version of this format.")
    name: Name = Field(default="", description="Name of the capture, for people.", examples=["glass ball"])
    program: Program = Field(description="What the monitor showed: enough to make the patterns again.")
    response: Response = Field(
        default="unknown",
        description="Tone curve of the camera, from light to stored value: `linear`, `srgb`, a gamma, or `unknown`, "
        "which has it estimated from the constant levels.",
    )
    # FailFast: only the first error is reported, because a list of all of them takes a kilobyte each.
    frames: Annotated[tuple[Frame, ...], FailFast()] = Field(
        default=(),
        description="The frames, in any order. Every pattern needs one, unless the capture is `unfinished`; frames of "
        "one pattern are averaged. Leave them out if there is a video.",
    )
    unfinished: bool = Field(
        default=False,
        description="Whether the program has not been shown to its end yet: then patterns may lack frames, and a video "
        "may end early, but for two different constant levels and one other pattern.",
    )
    video: Video | None = Field(default=None, description="A recording of the program, in place of frames.")
    mask: str | None = Field(
        default=None,
        description="Name of an image in the archive, of the frames' size. Pixels that are zero in it are not "
        "recovered.",
        examples=["mask.png"],
    )


def parse_manifest(text: bytes) -> Manifest:
    """Parse and validate the text of a capture.json.

    Raises
    ------
    CaptureError
        Naming the field that is wrong, and why.
    """
    if text.count(b"{") + text.count(b"[") > MANIFEST_NODES:
        raise CaptureError(
            f"{MANIFEST} has more than {MANIFEST_NODES} objects and lists",
            entry=MANIFEST,
            limit=MANIFEST_NODES,
        )
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise CaptureError(f"{MANIFEST} is in UTF-16: save it in UTF-8", entry=MANIFEST)
    try:
        # Editors and shells of Windows write the mark before UTF-8, which JSON does not have.
        return Manifest.model_validate_json(text.removeprefix(codecs.BOM_UTF8))
    except ValidationError as error:
        field, why = field_and_reason(error.errors(include_url=False))
        raise CaptureError(
            f"{MANIFEST}: {field + ': ' if field else ''}{why}", entry=MANIFEST, field=field
        ) from error
