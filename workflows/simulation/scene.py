"""A transparent object with known light transport: simulated frames, and captures made of them."""

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
    """A transparent object in front of a monitor, and the light transport from monitor to camera.

    Attributes
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's width and height in pixels.
    transport : three (height * width, monitor height * width) float32 CSR arrays
        rho T of red, green and blue: the light that each monitor pixel at full intensity adds to each camera pixel.
        Identical channels share one array.
    coverage : (height, width) float32
        The share of a camera pixel that the object covers, 0 to 1.
    reflections : (height, width, 3) float32, optional
        The light of the room that the object reflects and refracts to the camera; none if left out.
    """

    width: int
    height: int
    monitor: tuple[int, int]
    transport: Transports
    coverage: Floats
    reflections: Floats | None = None

    @cached_property
    def rho(self) -> Floats:
        """(height, width, 3) float32: the share of a white monitor's light that arrives, 0 to 1."""
        return self.composite(np.ones((1, 1, 1), np.float32))

    @property
    def object_mask(self) -> NDArray[np.bool_]:
        """(height, width) bool: where the object covers over half of a pixel and rho exceeds 5 % in all channels."""
        return (self.coverage > 0.5) & (self.rho > 0.05).all(axis=2)

    def composite(self, backdrop: Floats) -> Floats:
        """Compute the light that arrives, rho T L, without noise.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light of any size, stretched over the monitor.

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
        """Compute what the sensor of `film` would measure without noise, tone curve, clipping and rounding.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light of any size, stretched over the monitor.
        offset, gain : float
            As in `film`.

        Returns
        -------
        (height, width, 3) float32
            Linear light, ``offset + reflections + gain * composite(backdrop)``.
        """
        return self._still(offset) + np.float32(gain) * self.composite(backdrop)

    def _still(self, offset: float) -> Floats | np.float32:
        """The sensor's value without light from the monitor."""
        return np.float32(offset) + (np.float32(0) if self.reflections is None else self.reflections)

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
        """Simulate the frames of a pattern program, one per pattern.

        Parameters
        ----------
        program : Program
            Program for a monitor of this scene's size. An ``unknown`` response of the monitor is taken as sRGB.
        offset, gain : float
            The sensor's value without any light, and the increase for a white monitor seen directly.
        noise : float
            Factor on the noise. 1 is a read noise of 0.002 of full scale and a shot noise of 0.006 at full scale.
        depth : {8, 16}
            Bits per channel of a frame.
        response : {"linear", "srgb"}
            The camera's tone curve.
        seed : int
            Seed of the noise.
        images : sequence of (rows, columns, 1 or 3) float32
            Values sent to the monitor, 0 to 1, for the program's `Images` parts, in order.

        Returns
        -------
        iterator of (height, width, 3) uint8 or uint16
            Frames in the order of the patterns.

        Raises
        ------
        OptionError
            If the program's monitor has another size, or the number of images is wrong.

        Notes
        -----
        A pixel is curve(clip(v + n)), rounded, with v = offset + reflections + gain * light and normal noise n of the
        standard deviation noise * (0.002 + 0.006 sqrt(v)).
        """
        if (program.monitor.width, program.monitor.height) != self.monitor:
            raise OptionError("the program's monitor has another size than the scene's", field="program")
        needed = sum(part.count for part in program.parts if part.kind == "images")
        if len(images) != needed:
            raise OptionError(f"the program needs {needed} images, not {len(images)}", field="images")
        rng = np.random.Generator(np.random.PCG64(seed))
        still = self._still(offset)

        def frame(light: Floats) -> Frame:
            value = still + np.float32(gain) * light
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
    mask: bool | NDArray[np.bool_] = False,
    name: str = "",
    jpeg: int | None = None,
    **film: Unpack[FilmOptions],
) -> int:
    """Simulate the frames of a program and write a capture archive, a ZIP in the format envmatte-capture/1.

    The same arguments write the same bytes.

    Parameters
    ----------
    scene : Scene
    program : Program
        Files of its `Images` parts are written under their names, as PNG of 16 bits.
    target : Path or binary file
    mask : bool or (height, width) bool
        Whether to include the object's mask; or another mask to include.
    name : str
        Name of the capture; omitted if empty.
    jpeg : int, optional
        Quality of JPEG frames, 1 to 100; they are PNG if left out.
    **film
        Options of `Scene.film`.

    Returns
    -------
    int
        The number of frames.

    Raises
    ------
    OptionError
        As from `Scene.film`; nothing is written.
    """
    filmed = scene.film(program, **film)
    kind = "jpg" if jpeg else "png"
    frames = [{"file": f"frames/{n:05d}.{kind}", "pattern": n} for n in range(program.count)]
    masked = scene.object_mask if mask is True else mask
    manifest = {
        "format": "envmatte-capture/1",
        **({"name": name} if name else {}),
        "program": program.model_dump(mode="json", exclude_defaults=True),
        "response": film.get("response", "linear"),
        "frames": frames,
        **({} if masked is False else {"mask": "mask.png"}),
    }
    files = [file for part in program.parts if part.kind == "images" for file in part.files]
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:

        def add(entry: str, content: bytes | Frame) -> None:
            info = zipfile.ZipInfo(entry, date_time=(1980, 1, 1, 0, 0, 0))
            info.create_system = 3  # Unix, whatever the platform
            archive.writestr(info, content if isinstance(content, bytes) else imagecodecs.png_encode(content))

        add("capture.json", json.dumps(manifest, indent=1).encode())
        for file, image in zip(files, film.get("images", ()), strict=True):
            pixels = image[:, :, 0] if image.shape[2] == 1 else image
            add(file, np.round(pixels * 65535).astype(np.uint16))
        if masked is not False:
            add("mask.png", masked.astype(np.uint8) * np.uint8(255))
        for entry, frame in zip(frames, filmed, strict=True):
            encoded = bytes(imagecodecs.jpeg_encode(frame, jpeg, subsampling="444")) if jpeg else frame
            add(str(entry["file"]), encoded)
    return program.count
