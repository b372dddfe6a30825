"""Pictures that requests send as backdrops: what is none is refused with how to send it."""

from typing import IO

from fastapi import Request

from services.api.http.media_types import media_type_of
from services.decoding.first_bytes import LENGTH, is_video
from services.decoding.pool import Decoders
from services.runtime.problems import WrongMediaType
from storage.errors import ImageError
from workflows.composite.backdrops.backdrop import Backdrop, backdrop_of
from workflows.images.decode import Transfer


def refuse_form(request: Request) -> None:
    """Check, before the body comes, that it is not a form.

    Raises
    ------
    WrongMediaType
    """
    if media_type_of(request) == "multipart/form-data":
        raise WrongMediaType(
            "send the file itself as the body, not in a form: with curl by --data-binary @FILE, not by -F"
        )


def decode_backdrop(decoders: Decoders, body: IO[bytes], transfer: Transfer) -> Backdrop:
    """Decode a picture.

    Raises
    ------
    ImageError
    WrongMediaType
        If it is a video.
    """
    try:
        return backdrop_of(decoders.decode(body, transfer), transfer)
    except ImageError as error:
        body.seek(0)
        if is_video(body.read(LENGTH)):
            raise WrongMediaType(
                "this is a video, which was sent as a picture: send it with `Content-Type: video/mp4`"
            ) from error
        raise
