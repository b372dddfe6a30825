"""Media types of what is sent and of what is asked for: Content-Type and Accept."""

from collections.abc import Sequence

from fastapi import Request

from services.runtime.problems import WrongMediaType

ZIP = "application/zip"
JSON = "application/json"


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


def preferred(accept: str, offered: Sequence[str]) -> str | None:
    """Choose the media type that an Accept header likes best (RFC 9110, sect. 12.5.1); None if it takes none.

    Of two with the same quality the first one named is chosen; a wildcard means the first one offered that it matches.
    """
    ranges = []
    for part in accept.split(","):
        name, *parameters = (text.strip().lower() for text in part.split(";"))
        quality = next((text[2:] for text in parameters if text.startswith("q=")), "1")
        try:
            ranges.append((-float(quality), name))
        except ValueError:
            continue
    for worth, name in sorted(ranges, key=lambda one: one[0]):
        found = next((media_type for media_type in offered if _matches(name, media_type)), None)
        if worth and found:
            return found
    return None


def _matches(name: str, media_type: str) -> bool:
    return name in ("*/*", media_type) or (name.endswith("/*") and media_type.startswith(name[:-1]))
