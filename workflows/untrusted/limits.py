"""Limits on what an uploaded archive, picture or video may cost to read."""

from dataclasses import dataclass

from storage.errors import ImageError, OverLimit

MAX_FRAMES = 20_000
"""Frames, or patterns, of a capture, whatever is allowed."""


@dataclass(frozen=True)
class Limits:
    """What an uploaded archive or video may cost.

    Attributes
    ----------
    unpacked : int
        Bytes that all entries of an archive may unpack to together, that all frames may take once decoded, and that all
        images of patterns may.
    memory : int
        Bytes that one reader may hold. An entry, or a decoded image, may take a quarter of it.
    frames, pixels : int, optional
        Frames, or patterns, of a capture, and pixels of a frame; None sets no limit of its own.
    """

    unpacked: int
    memory: int
    frames: int | None = None
    pixels: int | None = None

    @property
    def image_bytes(self) -> int:
        """Bytes that one entry, or one decoded image, may take."""
        return self.memory // 4

    def check_frames(self, frames: int, **where: str) -> None:
        """Check that a capture may have ``frames`` frames, or patterns.

        Parameters
        ----------
        **where : str
            The ``entry``, and its ``field``, to name in the error.

        Raises
        ------
        OverLimit
        """
        if self.frames is not None and frames > self.frames:
            raise OverLimit(
                f"a capture may have {self.frames} frames or patterns, this one has {frames}; leave some out",
                **where,
                name="capture_frames",
                limit=self.frames,
                value=frames,
            )

    def check_pixels(self, width: int, height: int, **where: str) -> None:
        """Check that a frame may have ``width`` x ``height`` pixels.

        Parameters
        ----------
        **where : str
            The ``entry``, and its ``field``, to name in the error.

        Raises
        ------
        OverLimit
        """
        if self.pixels is not None and width * height > self.pixels:
            raise OverLimit(
                f"a frame may have {self.pixels} pixels, these have {width} x {height}; make them smaller",
                **where,
                name="capture_pixels",
                limit=self.pixels,
                value=width * height,
            )


def check_size(width: int, height: int, pixel: int, memory: int, what: str = "pixels") -> None:
    """Check, before a picture is decoded, that it fits into the memory allowed for one.

    Parameters
    ----------
    width, height : int
    pixel : int
        Bytes that each of them takes.
    memory : int
        Bytes that the picture may take.
    what : str
        What is counted, for the error.

    Raises
    ------
    ImageError
    """
    if width * height * pixel > memory:
        raise ImageError(
            f"an image of {width} x {height} {what} takes more than the {memory} bytes allowed for one: make it "
            "smaller, or ask for a higher limit",
            limit=memory,
        )
