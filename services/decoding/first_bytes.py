"""What a file is by its first bytes, for messages and for the command line: nothing is decoded here."""

LENGTH = 197
"""Bytes that are looked at."""
STILLS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"crx ")
"""What pictures call themselves that are kept as MP4 is."""
SYNC = b"\x47"
"""How each packet of a transport stream begins, every 188 bytes or every 192."""


def is_video(start: bytes) -> bool:
    """Whether a file's first bytes are those of MP4 or MOV, MKV or WebM, AVI, or a transport stream (MTS)."""
    # HEIC and CR3 are stills in the boxes of MP4.
    is_still = start[8:12] in STILLS
    return (
        (start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") and not is_still)
        or start[:4] == b"\x1aE\xdf\xa3"
        or (start[:4] == b"RIFF" and start[8:12] == b"AVI ")
        or (start[:1] == start[188:189] == SYNC and start[:4] != b"GIF8")
        or start[4:5] == start[196:197] == SYNC  # camcorders put a time before each packet
    )
