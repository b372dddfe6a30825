"""Random changes of real files, accidental and malicious; reproducible for a `Random`."""

import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

from tests.parts.captures import zip_bytes

EXTREMES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
"""Values at which counts and lengths overflow."""
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 17, 4096, 16384, 100_000, 2**31, 2**53, 2**63, 2**64, 10**30),
    *(0.5, 1e-9, -0.0, 1e308, 1e-320, float("nan"), float("inf")),
    *(
        "",
        "a",
        "../a",
        "/",
        "\0",
        "é\u0301",
        "a" * 300,
        "linear",
        "unknown",
        "constant",
        "bernoulli",
        "stripes",
        "images",
    ),
    *([], {}, [[]], [0, 1], ["a", "a"], {"gamma": 2.2}, {"": {}}),
)
"""Replacements for values of a JSON document."""
LARGEST = 1 << 18
"""Approximate size in bytes of repeated parts."""
SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_TYPES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 16, 17, 18, 0, 255)
TIFF_TAGS = (
    *(
        254,
        256,
        257,
        258,
        259,
        262,
        266,
        273,
        274,
        277,
        278,
        279,
        284,
        292,
        317,
        320,
        322,
        323,
        324,
        325,
        330,
        338,
    ),
    *(
        339,
        347,
        513,
        514,
        529,
        530,
        531,
        532,
        33421,
        33422,
        34665,
        34675,
        50714,
        50717,
        50718,
        50829,
        51008,
        52525,
    ),
)
"""Tags that decide how pixels are found and unpacked."""


def damaged(random: Random, data: bytes, marks: bytes | None = None, other: bytes = b"") -> bytes:
    """A file with some bytes changed, mostly near its start, perhaps truncated, partly repeated or spliced.

    Parameters
    ----------
    marks : bytes, optional
        A regular expression of what precedes counts and lengths, which are then changed as often as all
        the rest.
    other : bytes, optional
        Another file, parts of which may be spliced in.
    """
    out = bytearray(data)
    places = [match.end() for match in re.finditer(marks, data, re.S)] if marks else []
    for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
        if not out:
            break
        if places and random.random() < 0.5:
            at = min(random.choice(places) + random.randrange(48), len(out) - 1)
        else:
            at = random.randrange(min(random.choice((64, 600, len(out))), len(out)))
        random.choice((_bit, _byte, _number, _number, _cut_out, _repeat))(random, out, at)
    last = random.random()
    if last < 0.1:
        del out[random.randrange(len(out) + 1) :]
    elif last < 0.2 and (source := other or bytes(out)):
        start, at = random.randrange(len(source)), random.randrange(len(out) + 1)
        out[at : at + random.choice((0, len(out)))] = source[start : start + random.randrange(len(source))]
    return bytes(out)


def _bit(random: Random, out: bytearray, at: int) -> None:
    out[at] ^= 1 << random.randrange(8)


def _byte(random: Random, out: bytearray, at: int) -> None:
    out[at] = random.choice((0, 1, 0x7F, 0x80, 0xFF, random.randrange(256)))


def _number(random: Random, out: bytearray, at: int) -> None:
    size, order = random.choice((1, 2, 4, 4, 8)), random.choice(("little", "big"))
    here = int.from_bytes(out[at : at + size], order)
    near = here + random.choice((-1, 1, 16, -16)), here * 2, here << 8, len(out)
    value = random.choice((*EXTREMES, *near)) % (1 << 8 * size)
    out[at : at + size] = value.to_bytes(size, order)[: len(out) - at]


def _cut_out(random: Random, out: bytearray, at: int) -> None:
    del out[at : at + random.choice((1, 2, 4, 16, 256))]


def _repeat(random: Random, out: bytearray, at: int) -> None:
    piece = bytes(out[at : at + random.choice((1, 4, 16, 256))])
    out[at:at] = piece * random.choice((1, 2, 20))


FLOATS = (0.0, -0.0, -1.0, 2.0, 1e-45, 1e30, -1e30, float("inf"), float("-inf"), float("nan"))


def other_float(random: Random, data: bytes) -> bytes:
    """Values of 32 bits, one of them changed."""
    out = bytearray(data)
    if len(out) >= 4:
        struct.pack_into("<f", out, 4 * random.randrange(len(out) // 4), random.choice(FLOATS))
    return bytes(out)


def other_json(random: Random, document: Any) -> bytes:
    """JSON of a document with some values replaced, or parts removed, moved, nested or repeated."""
    text = json.dumps(document).encode()
    for _ in range(random.choice((1, 1, 2, 3))):
        if len(text) > LARGEST:
            break
        document = json.loads(text)  # without shared objects
        ways = [*_ways(document)]
        way = random.choice(ways)
        text = json.dumps(_put(document, way, _other_value(random, document, way, ways))).encode()
    if random.random() < 0.1:
        text = damaged(random, text)
    return text


def _ways(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths to everything in a document."""
    yield way
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in inside:
        yield from _ways(inner, (*way, key))


def _at(document: Any, way: Sequence[Any]) -> Any:
    for key in way:
        document = document[key]
    return document


_GONE = object()


def _other_value(random: Random, document: Any, way: Sequence[Any], ways: Sequence[Sequence[Any]]) -> Any:
    here = _at(document, way)
    what = random.randrange(10)
    if what == 0:
        return _GONE
    if what == 1:
        return _at(json.loads(json.dumps(document)), random.choice(ways))
    if what == 2:
        limit = LARGEST // len(json.dumps(here))
        return [here] * min(random.choice((1, 2, 3, 1000, 20_000)), limit)
    if what == 3:
        for _ in range(random.choice((1, 30, 190, 300))):
            here = [here] if random.random() < 0.5 else {"parts": here}
        return here
    if what == 4 and isinstance(here, int | float):
        return here + random.choice((-1, 1, 0.5))
    return random.choice(VALUES)


def _put(document: Any, way: Sequence[Any], value: Any) -> Any:
    if not way:
        return {} if value is _GONE else value
    inner = _at(document, way[:-1])
    if value is _GONE:
        del inner[way[-1]]
    else:
        inner[way[-1]] = value
    return document


ZIP_MARKS = rb"PK(?:\x01\x02|\x03\x04|\x05\x06|\x06\x06|\x06\x07)"


def damaged_zip(
    random: Random, files: dict[str, bytes], change: Callable[[Random, str, bytes], bytes]
) -> bytes:
    """A ZIP whose container is damaged, or one of whose entries was changed before packing."""
    files = dict(files)
    if random.random() < 0.5:
        name = random.choice([*files])
        files[name] = change(random, name, files[name])
        return zip_bytes(files, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    whole = zip_bytes(files, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    return damaged(random, whole, ZIP_MARKS)


def damaged_png(random: Random, data: bytes) -> bytes:
    """A PNG with some chunks changed, removed, repeated or moved, and correct checksums."""
    chunks, at = [], len(SIGNATURE)
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    for _ in range(random.choice((1, 1, 2))):
        n = random.randrange(len(chunks))
        kind, body = chunks[n]
        what = random.randrange(8)
        if what == 0 and len(chunks) > 1:
            del chunks[n]
        elif what == 1:
            chunks.insert(random.randrange(len(chunks) + 1), chunks[n])
        elif what == 2:
            kinds = (b"IHDR", b"PLTE", b"IDAT", b"tRNS", b"iCCP", b"acTL", b"fcTL", b"zTXt", b"eXIf", b"IEND")
            chunks[n] = (random.choice(kinds), body)
        elif kind == b"IDAT" and what < 6:
            try:
                rows = zlib.decompress(body)
            except zlib.error:
                continue
            chunks[n] = (kind, zlib.compress(damaged(random, rows)))
        else:
            chunks[n] = (kind, damaged(random, body))
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return SIGNATURE + b"".join(parts)


def damaged_tiff(random: Random, data: bytes) -> bytes:
    """A TIFF, or a camera RAW of that structure, with some tags changed."""
    out = bytearray(data)
    order = "<" if out.startswith(b"II") else ">"
    (first,) = struct.unpack_from(order + "I", out, 4)
    (count,) = struct.unpack_from(order + "H", out, first)
    for _ in range(random.choice((1, 1, 2, 3))):
        at = first + 2 + 12 * random.randrange(count)
        what = random.randrange(6)
        if what == 0:
            struct.pack_into(order + "H", out, at, random.choice(TIFF_TAGS))
        elif what == 1:
            struct.pack_into(order + "H", out, at + 2, random.choice(TIFF_TYPES))
        elif what == 2:
            struct.pack_into(order + "I", out, at + 4, random.choice((*EXTREMES, len(out))))
        else:
            value = random.choice((*EXTREMES, *range(16), len(out), random.randrange(len(out))))
            if random.random() < 0.5:
                struct.pack_into(order + "HH", out, at + 8, value & 0xFFFF, value >> 16)
            else:
                struct.pack_into(order + "I", out, at + 8, value)
    return bytes(out) if random.random() < 0.8 else damaged(random, bytes(out))
