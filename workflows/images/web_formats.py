"""WebP, AVIF and GIF for Pillow: loaded before a decoder is confined, in one thread. The files are not trusted."""

from PIL import AvifImagePlugin, GifImagePlugin, WebPImagePlugin

from workflows.untrusted.limits import check_size

FORMATS = tuple(
    str(plugin.format)
    for plugin in (WebPImagePlugin.WebPImageFile, AvifImagePlugin.AvifImageFile, GifImagePlugin.GifImageFile)
)
"""What Pillow calls them."""
AvifImagePlugin.DEFAULT_MAX_THREADS = 1  # as for everything else in a worker


def check_webp(data: bytes, memory: int) -> None:
    """Check the size of a WebP: opening one allocates the pixels already. Other bytes pass.

    Raises
    ------
    ImageError

    Notes
    -----
    The size is in the first chunk (WebP Container Specification): of the canvas in VP8X, else of the only frame.
    """
    kind, head = data[8:16], data[20:30]
    if kind == b"WEBPVP8X":
        width, height = 1 + int.from_bytes(head[4:7], "little"), 1 + int.from_bytes(head[7:10], "little")
    elif kind == b"WEBPVP8L":
        bits = int.from_bytes(head[1:5], "little")
        width, height = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    elif kind == b"WEBPVP8 ":
        width, height = (int.from_bytes(head[at : at + 2], "little") & 0x3FFF for at in (6, 8))
    else:
        return
    check_size(width, height, 4, memory)
