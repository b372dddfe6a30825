"""Pictures as arrays. Imported on first use, because importing numpy takes time."""

import io

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]


def encode(light: ArrayLike) -> bytes:
    """Encode linear light as an EXR.

    Parameters
    ----------
    light : (height, width), (height, width, 1) or (height, width, 3) float
        Grey or RGB.

    Raises
    ------
    ValueError
        If it has another shape, no pixels, or integers, whose encoding is unknown.
    """
    values = np.asarray(light)
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in (1, 3) or not values.size:
        raise ValueError(f"a backdrop is (height, width) or (height, width, 3), and not {np.shape(light)}")
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(
            f"a backdrop is linear light in floats, and not {values.dtype}; or send an image's bytes"
        )
    rgb = np.ascontiguousarray(np.broadcast_to(values, (*values.shape[:2], 3)), np.float32)
    file = io.BytesIO()
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": rgb}) as image:
        image.write(file)
    return file.getvalue()


def decode(data: bytes) -> Floats:
    """Decode an EXR.

    Returns
    -------
    (height, width), (height, width, 3) or (height, width, 4) float32
        One channel, RGB or RGBA.
    """
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
        planes: dict[str, Floats] = {
            name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()
        }
    if len(planes) == 1:
        (plane,) = planes.values()
        return plane
    return np.stack([planes[name] for name in "RGBA" if name in planes], axis=-1)
