"""What can go wrong, as one tree.

::

    EnvmatteError
    ├── InvalidInput            what was sent can't be used
    │   ├── CaptureError        a capture's archive or capture.json
    │   │   └── OverLimit       one that is larger than the service takes
    │   ├── ArchiveError        a matte's archive
    │   ├── ImageError          bytes that should be an image
    │   ├── ClipError           a clip to be a backdrop
    │   └── OptionError         an option of recovery
    ├── NotFound                no such capture, job, matte or frame
    ├── Conflict                it exists, but not in a state that allows this
    ├── NoRoom                  the store has no space for it, or its owner no more of it
    ├── TooMany                 as much is under way as may be at once
    ├── Unavailable             something the service needs can't be reached for now
    ├── Corrupt                 something stored is missing or damaged
    └── GaveUp                  work that failed as often as it may

Every error says in ``detail`` what is wrong and what to do; ``fields`` locate the fault (``entry``, ``field``,
``limit``). They cross process borders, so they are made of plain values only.
"""

DISK_FULL = (
    "the disk is full: delete captures, mattes or uploads, or free room on it, and try again; what was stored before "
    "is kept"
)


class EnvmatteError(Exception):
    """Base of every error that a caller can act on.

    Parameters
    ----------
    detail : str
        What is wrong and what to do about it, for people.
    **fields : str or int or float
        What locates the fault.
    """

    def __init__(self, detail: str, **fields: str | int | float) -> None:
        super().__init__(detail)
        self.detail = detail
        self.fields = fields

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.detail, self.fields)


def _rebuild(kind: type[EnvmatteError], detail: str, fields: dict[str, str | int | float]) -> EnvmatteError:
    return kind(detail, **fields)


class InvalidInput(EnvmatteError):
    """What was sent can't be used."""


class CaptureError(InvalidInput):
    """A capture's archive, its capture.json or one of its frames."""


class OverLimit(CaptureError):
    """A capture that is larger than the service takes."""


class ArchiveError(InvalidInput):
    """A matte's archive, or one of its entries."""


class ImageError(InvalidInput):
    """Bytes that should be an image."""


class ClipError(InvalidInput):
    """A clip to be a backdrop."""


class OptionError(InvalidInput):
    """An option of recovery that does not exist, is out of range, or does not go with the capture."""


class NotFound(EnvmatteError):
    """No such capture, job, matte or frame."""


class Conflict(EnvmatteError):
    """It exists, but is not in a state that allows this."""


class NoRoom(EnvmatteError):
    """The store has no space for it, or its owner no more of it."""


class TooMany(EnvmatteError):
    """As much is under way as may be at once."""


class Unavailable(EnvmatteError):
    """Something that the service needs can't be reached for now; the same may go well later."""


class Corrupt(EnvmatteError):
    """Something that the store should hold is missing or damaged."""


class GaveUp(EnvmatteError):
    """Work that failed as often as it may, for a reason nobody foresaw."""
