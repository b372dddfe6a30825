"""What a camera makes of the light: the blur and the glare of its lens, noise, and what a phone does to a picture."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import imagecodecs
import numpy as np
from scipy.ndimage import gaussian_filter

from workflows.images.integer_formats import to_unit
from workflows.images.tone_curves import to_light
from workflows.simulation.scene import Floats, Frame, Scene


class Camera(NamedTuple):
    """A camera; what is 0 is not there.

    Attributes
    ----------
    noise, depth
        As in `Scene.film`.
    blur : float
        Standard deviation of what the lens makes of a point, in pixels.
    veil : float
        Share of the light that the lens spreads evenly over the frame.
    sharpening : float
        Amount of an unsharp mask of one pixel's radius, of what is stored.
    quality : int
        Of a JPEG, whose colours have half the resolution. What it stores has the tone curve of sRGB.
    """

    noise: float = 1.0
    depth: Literal[8, 16] = 8
    blur: float = 0.0
    veil: float = 0.0
    sharpening: float = 0.0
    quality: int = 0

    @property
    def response(self) -> Literal["linear", "srgb"]:
        """The tone curve of what it stores."""
        return "srgb" if self.quality else "linear"

    @property
    def deviation(self) -> float:
        """About the standard deviation of a frame: from a third of it to a third more, by the light."""
        return 0.006 * self.noise

    @property
    def step(self) -> float:
        """The distance of two values of a frame."""
        return 1 / (255 if self.depth == 8 else 65535)

    def values(self, frame: Frame) -> Floats:
        """Linear values, 0 to 1, of a frame of `Scene.film`, by the known tone curve."""
        if not self.quality:
            return to_unit(frame)
        code = frame.astype(np.float32)
        code += np.float32(self.sharpening) * (code - gaussian_filter(code, (1, 1, 0)))
        stored = np.round(np.clip(code, 0, 255)).astype(np.uint8)
        file = imagecodecs.jpeg8_encode(stored, level=self.quality, subsampling="420")
        return to_light(to_unit(imagecodecs.jpeg8_decode(file)), "srgb")


CAMERAS = {
    "linear": Camera(),
    "RAW": Camera(noise=0.8, depth=16, blur=0.8, veil=0.01),
    "phone": Camera(noise=2.0, blur=1.0, veil=0.01, sharpening=0.5, quality=90),
}


@dataclass(frozen=True, eq=False)
class Seen(Scene):
    """A scene through the lens of a camera.

    Attributes
    ----------
    frost : float
        How far the object scatters light: the standard deviation in the monitor's pixels.
    lens : Camera
    """

    frost: float = 0.0
    lens: Camera = CAMERAS["linear"]

    def composite(self, backdrop: Floats) -> Floats:
        if self.frost:
            backdrop = gaussian_filter(backdrop, (self.frost, self.frost, 0), mode="constant")
        light = super().composite(backdrop)
        if self.lens.blur:
            light = gaussian_filter(light, (self.lens.blur, self.lens.blur, 0))
        veil = np.float32(self.lens.veil)
        return (1 - veil) * light + veil * light.mean(axis=(0, 1))
