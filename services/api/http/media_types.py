"""Media types of what is sent and of what is asked for: Content-Type and Accept."""

import re
from collections.abc import Sequence

from fastapi import Request

from services.runtime.problems import CodedBody, WrongMediaType

ZIP = "application/zip"
JSON = "application/json"
QUALITY = re.compile(r"0(\.[0-9]*)?|1(\.0*)?|\.[0-9]+")


def media_type_of(request: Request) -> str:
    """The media type of a body, in lower case and without parameters; empty if the request names none."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def require_media_type(request: Request, media_type: str, what: str) -> None:
    """Check that a body has the media type that a route takes.

    Parameters
    ----------
    what : str
        What the body is, for the message.

    Raises
    ------
    WrongMediaType
    """
    given = media_type_of(request)
    if given != media_type:
        raise WrongMediaType(f"send {what} as {media_type}, not as {given or 'nothing'}")


async def refuse_coded_body(request: Request) -> None:
    """Refuse a body with a content coding (RFC 9110, sect. 15.5.16): it would be read as if it had none.

    Raises
    ------
    CodedBody
    """
    coding = request.headers.get("content-encoding", "identity")
    if coding.strip().lower() != "identity":
        raise CodedBody(
            f"Content-Encoding: bodies in {coding!r} are not taken; send this one as it is, without this header",
            field="Content-Encoding",
        )


def preferred(accept: str, offered: Sequence[str]) -> str | None:
    """Choose the media type that an Accept header likes best (RFC 9110, sect. 12.5.1); None if it takes none.

    The most specific range that matches a type has its quality. Of two with the same quality, the one whose range comes
    first is chosen, and of two with the same range the first one offered.
    """
    ranges: dict[str, tuple[float, int]] = {}
    for place, part in enumerate(accept.split(",")):
        name, *parameters = (text.strip().lower() for text in part.split(";"))
        quality = next((text[2:] for text in parameters if text.startswith("q=")), "1")
        if QUALITY.fullmatch(quality):
            ranges.setdefault(name, (-float(quality), place))
    found: list[tuple[tuple[float, int], str]] = []
    for media_type in offered:
        matching = (media_type, f"{media_type.partition('/')[0]}/*", "*/*")
        rank = next((ranges[name] for name in matching if name in ranges), (0.0, 0))
        if rank[0]:
            found.append((rank, media_type))
    return min(found, key=lambda one: one[0])[1] if found else None
