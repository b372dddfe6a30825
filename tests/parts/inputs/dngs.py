"""DNGs that tests make."""

import io
from typing import Any

import tifffile
from numpy.typing import NDArray


def dng(
    counts: NDArray[Any],
    black: int,
    white: int,
    pattern: tuple[int, ...] = (0, 1, 1, 2),
    active: tuple[int, ...] = (),
    orientation: int = 1,
    neutral: tuple[int, int, int] = (100, 100, 100),
    thumbnail: NDArray[Any] | None = None,
    **how: Any,
) -> bytes:
    """A DNG of a sensor's counts, or of linear pixels, the least that LibRaw takes for one.

    ``neutral`` is what the camera sees of grey, in per cent. With a thumbnail, that is the file's first image, as
    cameras write it.
    """
    period = int(len(pattern) ** 0.5)
    tags = [
        (271, "s", 0, "Acme", True),
        (272, "s", 0, "Box", True),
        (274, "H", 1, orientation, True),
        (50706, "B", 4, bytes((1, 4, 0, 0)), True),  # the DNG's version
        (50708, "s", 0, "Acme Box", True),
        (50721, "2i", 9, tuple(v for n in range(9) for v in (int(n % 4 == 0), 1)), True),  # colour matrix
        (50728, "2I", 3, tuple(v for share in neutral for v in (share, 100)), True),
    ]
    sensor: list[Any] = [(50714, "I", 1, black, True), (50717, "I", 1, white, True)]
    if counts.ndim == 2:  # the colour filter's size, and its colours
        sensor += [(33421, "H", 2, (period, period), True), (33422, "B", period**2, bytes(pattern), True)]
    if active:  # top, left, bottom, right
        sensor.append((50829, "I", 4, active, True))
    target = io.BytesIO()
    if counts.ndim == 2:
        how["photometric"] = "cfa"
    else:
        how |= {"photometric": tifffile.PHOTOMETRIC.LINEAR_RAW, "planarconfig": "contig"}
    with tifffile.TiffWriter(target) as file:
        if thumbnail is None:
            sensor = tags + sensor
        else:
            file.write(thumbnail, photometric="rgb", subfiletype=1, subifds=1, extratags=tags)
        file.write(counts, extratags=sensor, **how)
    return target.getvalue()
