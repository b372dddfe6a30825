"""What a capture archive may cost."""

from dataclasses import dataclass

from storage.errors import OverLimit


@dataclass(frozen=True)
class Limits:
    """What a bundle may cost whoever reads it.

    Attributes
    ----------
    unpacked : int
        Bytes of all its entries together, and of all its frames once they are decoded.
    memory : int
        Bytes that one reader may hold; an entry, or an image decoded, may take a quarter of it.
    frames, pixels : int, optional
        How many frames it may have, and how many pixels one of them; no more limit than the others if None.
    """

    unpacked: int
    memory: int
    frames: int | None = None
    pixels: int | None = None

    @property
    def image(self) -> int:
        """Bytes that one entry, and one decoded image, may take."""
        return self.memory // 4

    def see_that_frames_may(self, frames: int, **where: str) -> None:
        """See that a capture may have so many frames.

        Parameters
        ----------
        **where : str
            ``entry`` that says so, and its ``field``.

        Raises
        ------
        OverLimit
        """
        if self.frames is not None and frames > self.frames:
            raise OverLimit(
                f"a capture may have {self.frames} frames, this one has {frames}; leave some out",
                **where,
                name="capture_frames",
                limit=self.frames,
                value=frames,
            )

    def see_that_pixels_may(self, width: int, height: int, **where: str) -> None:
        """See that frames may be so large; the same."""
        if self.pixels is not None and width * height > self.pixels:
            raise OverLimit(
                f"a frame may have {self.pixels} pixels, and these have {width} x {height}; make them smaller",
                **where,
                name="capture_pixels",
                limit=self.pixels,
                value=width * height,
            )
