"""The errors that callers can act on, as one tree.

::

    EnvmatteError
    ├── InvalidInput            something sent to us cannot be used
    │   ├── CaptureError        a capture archive or its capture.json
    │   │   └── OverLimit       a capture above one of the service's limits
    │   ├── ArchiveError        a matte archive
    │   ├── ImageError          an image that cannot be read
    │   ├── ClipError           a backdrop clip that cannot be read
    │   └── OptionError         a recovery option
    ├── NotFound                no such capture, job, matte or frame
    ├── Conflict                it exists, but its state does not allow this
    ├── NoRoom                  the store is full, or the owner has used up their share
    ├── TooMany                 too many uploads, jobs or requests at the same time
    ├── Unavailable             something that the service needs cannot be reached now
    │   └── StoreUnavailable    the object store
    │       └── WrongStore      what is there is not the store of this installation
    ├── Corrupt                 stored data is missing or damaged
    └── GaveUp                  work that failed in all of its attempts

The ``detail`` of an error says what is wrong and what to do; its ``fields`` locate the fault (``entry``, ``field``,
``limit``). Errors are sent between processes, so they hold plain values only.
"""

DISK_FULL = (
    "the disk is full: delete captures, mattes or uploads, or free space on the disk, and try again; everything stored "
    "before is kept"
)

NEARLY_FULL = (
    "the disk is full, apart from a reserve for what is under way: delete captures, mattes or uploads, or free space "
    "on the disk, and try again; everything stored before is kept"
)

FEW_FILES = (
    "the disk takes hardly any more files: delete captures, mattes or uploads, or other files on the disk, and try "
    "again; everything stored before is kept"
)


class EnvmatteError(Exception):
    """Base of every error that a caller can act on.

    Parameters
    ----------
    detail : str
        What is wrong and what to do about it, in words.
    **fields : str or int or float
        Where the fault is.
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
    """Something sent to us cannot be used."""


class CaptureError(InvalidInput):
    """A capture archive, its capture.json or one of its frames cannot be used."""


class OverLimit(CaptureError):
    """A capture exceeds one of the service's limits."""


class ArchiveError(InvalidInput):
    """A matte archive or one of its entries cannot be used."""


class ImageError(InvalidInput):
    """An image cannot be read."""


class ClipError(InvalidInput):
    """A backdrop clip cannot be read."""


class OptionError(InvalidInput):
    """A recovery option does not exist, is out of range, or does not suit the capture."""


class NotFound(EnvmatteError):
    """There is no such capture, job, matte or frame."""


class Conflict(EnvmatteError):
    """The state of something does not allow this."""


class NoRoom(EnvmatteError):
    """The store is full, or the owner has used up their share of it."""


class TooMany(EnvmatteError):
    """There are too many uploads, jobs or requests at the same time."""


class Unavailable(EnvmatteError):
    """Something that the service needs cannot be reached now; a later attempt may succeed."""


class StoreUnavailable(Unavailable):
    """The object store cannot be reached now."""


class WrongStore(StoreUnavailable):
    """What a machine sees in place of the installation's store is another one, such as a folder that is not mounted."""


class Corrupt(EnvmatteError):
    """Stored data is missing or damaged."""


class GaveUp(EnvmatteError):
    """Work failed in all of its attempts, for an unexpected reason."""
