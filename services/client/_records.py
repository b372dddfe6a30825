"""Records that the service returns: captures, jobs and mattes; and the error of a job."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

from services.client._errors import ServiceError, foreign

if TYPE_CHECKING:
    from services.client._arrays import Floats

LAYERS = ("S", "rho", "alpha", "confidence")


@dataclass(frozen=True, kw_only=True)
class Record:
    """Something that the service stores.

    Attributes
    ----------
    answer : dict
        The whole JSON object of the answer; ``record["name"]`` reads a field of it.
    """

    path: ClassVar[str]
    """Path of the collection."""
    id: str
    state: str
    created_at: str
    answer: dict[str, Any] = field(repr=False)

    @classmethod
    def of(cls, answer: dict[str, Any], **more: Any) -> Self:
        """Make a record of an answer. Fields that only a newer service has are in `answer`.

        A field that an older service lacks has its default.
        """
        try:
            known = {
                f.name: answer[f.name]
                for f in fields(cls)
                if f.name not in ("answer", *more) and (f.name in answer or f.default is MISSING)
            }
        except (KeyError, TypeError) as error:
            raise foreign() from error
        return cls(answer=answer, **known, **more)

    def __getitem__(self, name: str) -> Any:
        return self.answer[name]


@dataclass(frozen=True, kw_only=True)
class Capture(Record):
    """A capture; ``state`` is ``ingesting``, ``ready`` or ``failed``, ``job`` the id of its ingest job.

    ``width``, ``height`` are in pixels, and None until they are known. Times are RFC 3339, UTC.
    """

    path = "/v1/captures"
    name: str
    job: str
    width: int | None
    height: int | None
    frames: int
    bytes: int
    problem: dict[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class Job(Record):
    """A job; ``state`` is ``queued``, ``running``, ``succeeded``, ``failed`` or ``cancelled``.

    ``progress`` goes from 0 to 1 and never back; ``tiles`` has ``total``, ``done`` and ``failed``; ``waits_for`` says
    what the job waits for; ``matte`` is the id of the matte that it makes. ``name`` is that of the matte, or else of
    the capture; it is empty once they are deleted, or if the service is older than names of jobs.
    """

    path = "/v1/jobs"
    kind: str
    name: str = ""
    stage: str
    progress: float
    tiles: dict[str, int]
    eta_seconds: float | None
    waits_for: str | None
    capture: str | None
    matte: str | None
    options: dict[str, Any]
    problem: dict[str, Any] | None
    finished_at: str | None

    @property
    def ended(self) -> bool:
        """Whether it has ended, in success or not."""
        return self.state in ("succeeded", "failed", "cancelled")


class JobFailed(ServiceError):
    """A job failed or was cancelled: ``job``."""

    def __init__(self, job: Job) -> None:
        detail = f"job {job.id} was cancelled"
        super().__init__(job.problem or {"title": "Cancelled", "status": 409, "detail": detail})
        self.job = job


class Layers(Mapping[str, "Floats"]):
    """The layers of a matte: ``S``, ``rho``, ``alpha`` and ``confidence``, each fetched from the service on access.

    (height, width, 3), or (height, width) where it has one channel; float32, linear.
    """

    def __init__(self, get: Callable[[str], bytes]) -> None:
        self._get = get

    def __getitem__(self, name: str) -> "Floats":
        from services.client import _arrays

        if name not in LAYERS:
            raise KeyError(f"{name}: a matte has the layers {', '.join(LAYERS)}")
        return _arrays.decode(self._get(f"{name}.exr"))

    def __iter__(self) -> Iterator[str]:
        return iter(LAYERS)

    def __len__(self) -> int:
        return len(LAYERS)


@dataclass(frozen=True, kw_only=True)
class Matte(Record):
    """A matte; ``state`` is ``recovering``, ``ready`` or ``failed``.

    ``width`` and ``height`` are in pixels, as is ``monitor``, the size of the monitor; None until they are known. An
    imported matte has no ``capture`` and no ``job``. ``name`` is empty if the service is older than names of mattes.
    """

    path = "/v1/mattes"
    name: str = ""
    capture: str | None
    job: str | None
    options: dict[str, Any]
    width: int | None
    height: int | None
    monitor: list[int] | None
    layers: Layers = field(repr=False, compare=False)
