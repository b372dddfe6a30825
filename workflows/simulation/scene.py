"""A transparent object whose light transport is known: what a camera sees of it, and a capture of that."""

import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal, TypedDict, Unpack

import imagecodecs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.images.resample import area_mean
from workflows.images.tone_curves import from_light, to_light
from workflows.programs.program import Program

Floats = NDArray[np.float32]
Frame = NDArray[np.uint8] | NDArray[np.uint16]
Transport = sp.csr_array[np.float32, tuple[int, int]]
Transports = tuple[Transport, Transport, Transport]


class FilmOptions(TypedDict, total=False):
    """The options of `Scene.film`."""

    offset: float
    gain: float
    noise: float
    depth: Literal[8, 16]
    response: Literal["linear", "srgb"]
    seed: int
    images: Sequence[Floats]


@dataclass(frozen=True, eq=False)
class Scene:
    """A transparent object before a monitor, and the light transport between monitor and camera.

    Attributes
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's width and height in pixels.
    transport : three (height * width, monitor height * width) float32 CSR arrays
        rho T of red, green and blue: what each monitor pixel at full light adds to each camera pixel.
        Channels that are alike share one array.
    coverage : (height, width) float32
        The share of a camera pixel that the object covers, 0 to 1.
    """

    width: int
    height: int
    monitor: tuple[int, int]
    transport: Transports
    coverage: Floats

    @cached_property
    def rho(self) -> Floats:
        """(height, width, 3) float32: the share of an evenly lit monitor's light that arrives, 0 to 1."""
        return self.composite(np.ones((1, 1, 1), np.float32))

    @property
    def object_mask(self) -> NDArray[np.bool_]:
        """(height, width) bool: mostly object, and more than 5 % of the light arrives in every channel."""
        return (self.coverage > 0.5) & (self.rho > 0.05).all(axis=2)

    def composite(self, backdrop: Floats) -> Floats:
        """The light that arrives without noise, rho T L.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light at any size, stretched over the monitor.

        Returns
        -------
        (height, width, 3) float32
            Linear light.
        """
        channels = backdrop.shape[2]
        shown = area_mean(backdrop, *self.monitor).reshape(-1, channels)
        arriving = np.empty((self.height * self.width, 3), np.float32)
        for c in range(3):
            if c and channels == 1 and self.transport[c] is self.transport[c - 1]:
                arriving[:, c] = arriving[:, c - 1]
            else:
                arriving[:, c] = self.transport[c] @ shown[:, min(c, channels - 1)]
        return arriving.reshape(self.height, self.width, 3)

    def truth(self, backdrop: Floats, *, offset: float = 0.02, gain: float = 0.9) -> Floats:
        """What the sensor of `film` would see of a backdrop without noise, curve, clipping and rounding.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light at any size, stretched over the monitor.
        offset, gain : float
            As given to `film`.

        Returns
        -------
        (height, width, 3) float32
            Linear light, ``offset + gain * composite(backdrop)``.
        """
        return np.float32(offset) + np.float32(gain) * self.composite(backdrop)

    def film(
        self,
        program: Program,
        *,
        offset: float = 0.02,
        gain: float = 0.9,
        noise: float = 1.0,
        depth: Literal[8, 16] = 8,
        response: Literal["linear", "srgb"] = "linear",
        seed: int = 0,
        images: Sequence[Floats] = (),
    ) -> Iterator[Frame]:
        """Film a pattern program, one frame a pattern.

        Parameters
        ----------
        program : Program
            For a monitor of this scene's size. A monitor of ``unknown`` response is filmed as sRGB.
        offset, gain : float
            Ambient light, and the sensor's value for an evenly lit monitor seen directly, less that.
        noise : float
            1 is a sensor with a read noise of 0.002 of full scale and a shot noise of 0.006 at full scale.
        depth : {8, 16}
            Bits of a frame.
        response : {"linear", "srgb"}
            The camera's curve.
        seed : int
            Of the noise.
        images : sequence of (rows, columns, 1 or 3) float32
            Values sent to the monitor, 0 to 1, for the program's `Images` parts, in order.

        Returns
        -------
        iterator of (height, width, 3) uint8 or uint16
            In order of the patterns.

        Raises
        ------
        OptionError
            If the program is for a monitor of another size, or a number of images does not fit it.

        Notes
        -----
        With v = offset + gain * light and n normal of deviation noise * (0.002 + 0.006 sqrt(v)), a pixel
        stores curve(clip(v + n)), rounded.
        """
        if (program.monitor.width, program.monitor.height) != self.monitor:
            raise OptionError(
                "the program is for a monitor of another size than the scene's", field="program"
            )
        wanted = sum(part.count for part in program.parts if part.kind == "images")
        if len(images) != wanted:
            raise OptionError(f"the program shows {wanted} images, {len(images)} are given", field="images")
        rng = np.random.Generator(np.random.PCG64(seed))

        def frame(light: Floats) -> Frame:
            value = np.float32(offset) + np.float32(gain) * light
            spread = noise * (0.002 + 0.006 * np.sqrt(np.maximum(value, 0)))
            value = value + spread * rng.standard_normal(value.shape, dtype=np.float32)
            stored = from_light(np.clip(value, 0, 1), response)
            if depth == 8:
                return np.round(stored * 255).astype(np.uint8)
            return np.round(stored * 65535).astype(np.uint16)

        curve = "srgb" if program.monitor.response == "unknown" else program.monitor.response
        pictures = program.pictures(0, program.count, images)
        return (frame(self.composite(to_light(picture, curve))) for picture in pictures)


def write_capture(
    scene: Scene,
    program: Program,
    target: Path | BinaryIO,
    *,
    mask: bool = False,
    name: str = "",
    **film: Unpack[FilmOptions],
) -> int:
    """Film a program and write the capture, a ZIP in the format envmatte-capture/1.

    Parameters
    ----------
    scene : Scene
    program : Program
        Names of the files of `Images` parts are taken as they are; the files are PNG of 16 bits.
    target : Path or binary file
        The same arguments write the same bytes.
    mask : bool
        Whether to add the object's mask.
    name : str
        The capture's name, left out if empty.
    **film
        Options of `Scene.film`.

    Returns
    -------
    int
        The number of frames.

    Raises
    ------
    OptionError
        As `Scene.film`, and nothing is written.
    """
    filmed = scene.film(program, **film)
    frames = [{"file": f"frames/{n:05d}.png", "pattern": n} for n in range(program.count)]
    record = {
        "format": "envmatte-capture/1",
        **({"name": name} if name else {}),
        "program": program.model_dump(mode="json", exclude_defaults=True),
        "response": film.get("response", "linear"),
        "frames": frames,
        **({"mask": "mask.png"} if mask else {}),
    }
    files = [file for part in program.parts if part.kind == "images" for file in part.files]
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:

        def add(entry: str, content: bytes | Frame) -> None:
            info = zipfile.ZipInfo(entry, date_time=(1980, 1, 1, 0, 0, 0))
            info.create_system = 3  # as on Unix, wherever this runs
            archive.writestr(info, content if isinstance(content, bytes) else imagecodecs.png_encode(content))

        add("capture.json", json.dumps(record, indent=1).encode())
        for file, image in zip(files, film.get("images", ()), strict=True):
            pixels = image[:, :, 0] if image.shape[2] == 1 else image
            add(file, np.round(pixels * 65535).astype(np.uint16))
        if mask:
            add("mask.png", scene.object_mask.astype(np.uint8) * np.uint8(255))
        for entry, frame in zip(frames, filmed, strict=True):
            add(str(entry["file"]), frame)
    return program.count
