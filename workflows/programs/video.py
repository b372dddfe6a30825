"""A program as a video to film: the lead-in, the patterns in a numbered border, the lead-out."""

import json
import math
import os
import tempfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import IO, Any

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.programs.border import LEAD, Border, draw_border, schedule
from workflows.programs.files import pictures, program_json
from workflows.programs.program import Program

FORMATS = {".mp4": "mp4", ".mkv": "matroska"}
"""Containers by file extension."""
FRAMES_PER_SECOND = 6
"""The least frame rate: a picture is repeated, so that a player that drops a frame drops no pattern."""
SLOWEST, FASTEST = 0.1, 30.0
"""Patterns a second."""


def film_manifest(program: Program, border: Border, rate: float) -> dict[str, Any]:
    """The capture.json for a film of the video, if the film is called `film.mp4`."""
    video = {"file": "film.mp4", "patterns_per_second": rate, "border": border.model_dump(mode="json")}
    return {"format": "envmatte-capture/1", "program": program_json(program), "video": video}


def write_video(program: Program, path: Path, rate: float, progress: Callable[[int, int], None]) -> None:
    """Write a video, and its `film_manifest` beside it under the same name with the extension `.json`.

    Parameters
    ----------
    program : Program
        As `workflows.programs.files.fit_to_screen` returns it.
    path : Path
        With an extension of `FORMATS`. Both files are written completely or not at all.
    rate : float
        Patterns a second.
    progress : callable
        As for `encode_video`.

    Raises
    ------
    OptionError
        If one of the files exists already.
    """
    path = path.resolve()
    beside = path.with_suffix(".json")
    for file in (path, beside):
        if file.exists():
            raise OptionError(f"{file} exists already: name another file, or remove it", field="out")
    path.parent.mkdir(parents=True, exist_ok=True)
    border = Border.around(program.monitor.width, program.monitor.height)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
        film, text = Path(folder, path.name), Path(folder, beside.name)
        text.write_text(json.dumps(film_manifest(program, border, rate), indent=1) + "\n")
        with film.open("wb") as target:
            encode_video(program, target, rate, FORMATS[path.suffix.lower()], progress)
        os.replace(film, path)
        os.replace(text, beside)


def encode_video(
    program: Program,
    target: IO[bytes],
    rate: float,
    container: str = "mp4",
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> None:
    """Encode a program as a video.

    Parameters
    ----------
    program : Program
        Without images.
    target : file
        To write to, seekable.
    rate : float
        Patterns a second.
    container : str
        A value of `FORMATS`.
    progress : callable
        Called with the number of pictures encoded, lead-in and lead-out included, and of all pictures.

    Raises
    ------
    OptionError
        If there is no room for a border, the rate is out of range, or there are too many patterns.

    Notes
    -----
    The video is lossless H.264 (``qp`` 0) in YCbCr 4:4:4 of full range: grey is exact and colours are exact to 1/255.
    VLC, mpv, Chromium and other software decoders play it. Hardware decoders only take 4:2:0, which lost 4/255 when
    measured; FFV1 keeps RGB exact, but fewer players have it. Every pattern has the same whole number of frames, so the
    rate is exact.
    """
    if not SLOWEST <= rate <= FASTEST:
        raise OptionError(f"{rate} patterns a second: choose {SLOWEST} to {FASTEST}", field="rate")
    border = Border.around(program.monitor.width, program.monitor.height)
    steps = schedule(program.count, rate)
    frame_rate = Fraction(rate).limit_denominator(1000) * math.ceil(FRAMES_PER_SECOND / rate)
    shown = pictures(program)
    at = 0
    with av.open(target, "w", format=container) as video:
        stream = video.add_stream("libx264", rate=frame_rate, options={"qp": "0", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = border.width, border.height, "yuv444p"
        codec = stream.codec_context
        codec.thread_count = 2  # fixed: memory grows with it, and the bytes may depend on it
        codec.color_range, codec.colorspace = ColorRange.JPEG, Colorspace.ITU709
        codec.color_primaries, codec.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
        codec.time_base = 1 / frame_rate
        for n, step in enumerate(steps):
            level = np.full((1, 1, 1), 255 * step.white, np.uint8)
            picture = level if step.number == LEAD else next(shown)
            frame = _frame(draw_border(picture, step.number, border))
            for _ in range(max(round(step.seconds * frame_rate), 1)):
                frame.pts = at
                video.mux(stream.encode(frame))
                at += 1
            progress(n + 1, len(steps))
        video.mux(stream.encode(None))


def _frame(pixels: NDArray[np.uint8]) -> av.VideoFrame:
    """A frame of pixels, (height, width, 1 or 3), in the encoder's colour system."""
    wide = np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))
    return av.VideoFrame.from_ndarray(wide, "rgb24").reformat(
        format="yuv444p",
        dst_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.JPEG,
    )
