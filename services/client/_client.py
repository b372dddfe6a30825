"""The client's calls."""

import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Self, overload

from services.client import _download
from services.client._errors import FileChanged, NotFound, foreign
from services.client._paths import id_of, path_of, state_of
from services.client._records import Capture, Job, JobFailed, Layers, Matte, Record

if TYPE_CHECKING:
    from services.client._arrays import Floats

_PAGE = 100
"""Records that are read at a time."""
SENT = 64 << 10
"""Bytes of an archive that are read and sent at a time."""


class Client:
    """A connection to a service, for one thread at a time.

    Parameters
    ----------
    url : str
        Of the service, e.g. ``http://127.0.0.1:8000``.
    key : str, optional
        API key.

    Raises
    ------
    ValueError
        If the URL is not an HTTP URL, or a proxy that the environment names can't be used.
    InvalidKey
        If the key can't be sent.

    Notes
    -----
    Every call raises `ServiceError` if the service answers with a problem, or does not answer.
    """

    def __init__(self, url: str, key: str | None = None) -> None:
        from services.client._session import Session

        self._http = Session(url, key)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def upload(
        self,
        file: Path | str,
        *,
        name: str = "",
        progress: Callable[[int, int], None] | None = None,
        webhook: str | None = None,
    ) -> Capture:
        """Upload a capture.

        The upload survives lost connections and restarts of the service. To continue one that was interrupted, call
        this again for the same file before the upload expires.

        Parameters
        ----------
        name : str
            A name for people.
        progress : callable, optional
            Is called with the bytes that the service has, and with all there are.
        webhook : str, optional
            URL to notify when the capture is ingested.
        """
        from services.client import _upload

        body = {"name": name} | ({"webhook": webhook} if webhook else {})
        return Capture.of(_upload.send(self._http, Path(file), body, progress))

    def recover(
        self,
        capture: Capture | str,
        *,
        webhook: str | None = None,
        region: tuple[int, int, int, int] | None = None,
        **options: Any,
    ) -> Job:
        """Queue the recovery of a matte.

        Parameters
        ----------
        webhook : str, optional
            URL to notify when the job has ended.
        region : (x, y, width, height), optional
            The part of the frame that is recovered first, in pixels.
        **options
            As ``GET /v1/options`` lists them.

        Raises
        ------
        ValueError
            If `region` is not four numbers.
        """
        body: dict[str, Any] = {"capture": id_of(capture), "options": options}
        body |= ({"webhook": webhook} if webhook else {}) | ({"region": _region(region)} if region else {})
        return Job.of(self._http.json("POST", Job.path, json=body, headers=_key()))

    def job(self, job: Job | str) -> Job:
        """Get the current state of a job."""
        return Job.of(self._http.json("GET", path_of(Job, job)))

    def pause(self, job: Job | str) -> Job:
        """Pause a job; what is under way is done."""
        return self._change(job, paused=True)

    def resume(self, job: Job | str) -> Job:
        """Continue a job that is paused."""
        return self._change(job, paused=False)

    def recover_first(self, job: Job | str, region: tuple[int, int, int, int]) -> Job:
        """Recover a part of the frame first: x, y, width and height in pixels. The rest follows."""
        return self._change(job, region=_region(region))

    def _change(self, job: Job | str, **changes: Any) -> Job:
        return Job.of(self._http.json("PATCH", path_of(Job, job), json=changes, safe=True))

    def cancel(self, job: Job | str) -> Job:
        """Cancel a job; cancelling it again changes nothing."""
        return Job.of(self._http.json("POST", f"{path_of(Job, job)}/cancel", safe=True))

    def wait(
        self, job: Job | Capture | str, *, progress: Callable[[Job], None] | None = None, poll: float = 0.2
    ) -> Job:
        """Wait until a job, or the ingest job of a capture, has ended; raises `JobFailed` unless it succeeded.

        Waiting survives restarts of the service.

        Parameters
        ----------
        progress : callable, optional
            Is called with the job each time it is read.
        poll : float
            Seconds between polls at first; a long job is polled once a second.
        """
        which = job.job if isinstance(job, Capture) else id_of(job)
        begun = time.monotonic()
        while True:
            found = self.job(which)
            if progress:
                progress(found)
            if found.state == "succeeded":
                return found
            if found.ended:
                raise JobFailed(found)
            time.sleep(max(poll, min((time.monotonic() - begun) / 20, 1.0)))

    def capture(self, capture: Capture | str) -> Capture:
        """Get the current state of a capture."""
        return Capture.of(self._http.json("GET", path_of(Capture, capture)))

    def report(self, capture: Capture | str) -> dict[str, Any]:
        """Get the report on a capture that is ready: its ``level``, its ``findings``, and the figures behind them."""
        return self._http.json("GET", f"{path_of(Capture, capture)}/report")

    def matte(self, matte: Matte | Job | str) -> Matte:
        """Get the current state of a matte, or of the matte that a job makes."""
        which = (matte.matte or "") if isinstance(matte, Job) else matte
        return self._matte(self._http.json("GET", path_of(Matte, which)))

    def captures(self, **wanted: str) -> Iterator[Capture]:
        """All captures, newest first: those of a ``state``, or whose name contains ``name``.

        They are read page by page: make a list of them before you delete any.
        """
        return map(Capture.of, self._all(Capture, wanted))

    def jobs(self, **wanted: str) -> Iterator[Job]:
        """All jobs, newest first, or those of a ``state``."""
        return map(Job.of, self._all(Job, wanted))

    def mattes(self, **wanted: str) -> Iterator[Matte]:
        """All mattes, newest first: those of a ``state``, of a ``capture``, or whose name contains ``name``."""
        return map(self._matte, self._all(Matte, wanted))

    def _all(self, kind: type[Record], wanted: Mapping[str, str]) -> Iterator[dict[str, Any]]:
        """The answers of all pages of a collection."""
        query = {**wanted, "limit": str(_PAGE)}
        while True:
            page = self._http.json("GET", kind.path, params=query).get(kind.path.rpartition("/")[2])
            if not isinstance(page, list):
                raise foreign()
            yield from page
            if len(page) < _PAGE:
                return
            query["after"] = page[-1]["id"]

    def delete(self, record: Capture | Job | Matte) -> None:
        """Delete a capture, a matte, or a job that has ended; a retry of a delete that succeeded is no error."""
        tried = 0

        def delete() -> None:
            nonlocal tried
            tried += 1
            self._http.once("DELETE", path_of(type(record), record))

        try:
            self._http.patiently(delete)
        except NotFound:
            if tried == 1:
                raise

    @overload
    def composite(
        self,
        matte: Matte | str,
        backdrop: bytes | Path,
        *,
        kind: str = "image/png",
        **wanted: str | float,
    ) -> bytes: ...

    @overload
    def composite(
        self, matte: Matte | str, backdrop: "Floats", *, kind: str = ..., **wanted: str | float
    ) -> "Floats": ...

    def composite(
        self,
        matte: Matte | str,
        backdrop: "bytes | Path | Floats",
        *,
        kind: str = "image/png",
        **wanted: str | float,
    ) -> "bytes | Floats":
        """Composite a matte before a backdrop. An image, as a file or bytes, gives an image; an array gives an array.

        Parameters
        ----------
        backdrop : bytes, Path, or (height, width) or (height, width, 3) float array
            An image (PNG, JPEG, WebP, AVIF, GIF, TIFF, HEIC, EXR, Radiance HDR or camera RAW), or an array of linear
            light. It is stretched over the monitor.
        kind : str
            Media type of the bytes: ``image/png``, ``image/jpeg`` or ``image/x-exr``.
        **wanted
            Further parameters: ``transfer``, ``x``, ``y``, ``width``, ``height``, ``size``, ``scale``, ``interval`` and
            so on.

        Returns
        -------
        bytes, or (height, width, 3 or 4) float32
            Linear light in arrays, of the matte's size unless another was asked for; with alpha if there is a mask,
            which light is multiplied with.
        """
        if isinstance(backdrop, bytes | Path):
            data = backdrop.read_bytes() if isinstance(backdrop, Path) else backdrop
            return self._composite(matte, data, kind, wanted)
        from services.client import _arrays

        return _arrays.decode(self._composite(matte, _arrays.encode(backdrop), "image/x-exr", wanted))

    def _composite(
        self, matte: Matte | str, backdrop: bytes, kind: str, wanted: dict[str, str | float]
    ) -> bytes:
        return self._http.send(
            "POST",
            f"{path_of(Matte, matte)}/composite",
            safe=True,
            computing=True,
            file=True,
            params=wanted,
            content=backdrop,
            headers={"Accept": kind},
        ).content

    def composite_clip(
        self, matte: Matte | str, clip: Path, *, webhook: str | None = None, **wanted: str | float
    ) -> Job:
        """Queue the composite of a clip, a video file; `video` downloads the result of the job.

        Parameters
        ----------
        webhook : str, optional
            URL to notify when the job has ended.
        **wanted
            ``transfer``, ``around``, ``fit``, ``right``, ``down``, ``scale`` and ``angle``, as the call takes them.
        """
        wanted |= {"webhook": webhook} if webhook else {}
        size = state_of(clip).st_size
        headers = {"Content-Type": "video/*", "Content-Length": str(size)} | _key()
        path = f"{path_of(Matte, matte)}/composite"
        return Job.of(
            self._http.json("POST", path, params=wanted, headers=headers, content=lambda: _parts(clip, size))
        )

    def video(self, job: Job | str, target: BinaryIO) -> None:
        """Write the video of a composite job, an MP4, to a file, a few megabytes at a time."""
        _download.by_ranges(self._http, f"{path_of(Job, job)}/video.mp4", target)

    def layer(self, matte: Matte | str, name: str, *, plate: bool = False) -> bytes:
        """Get a layer of a matte as a file, such as ``confidence.png``; ``Matte.layers`` has them as arrays.

        With ``plate``, ``stmap.exr`` and the nodes of Blender and Nuke take a plate of the frame, which the glass goes
        over, in place of a picture that is stretched over the monitor.
        """
        path, params = f"{path_of(Matte, matte)}/layers/{name}", {"plate": "true"} if plate else {}
        file = not name.endswith(".html")
        return self._http.send("GET", path, params=params, computing=True, file=file).content

    def live_page(self, matte: Matte | str) -> bytes:
        """Get a matte as a web page in one file, which draws the glass without a service."""
        return self._http.send("GET", f"{path_of(Matte, matte)}/live.html", computing=True).content

    def share(self, matte: Matte | str, days: float = 30) -> str:
        """Make a link by which anyone can see a matte, live, without a key; returns its URL.

        `GET /v1/mattes/{id}/links` lists links, and DELETE deletes one.

        Parameters
        ----------
        days : float
            Until the link expires, 3650 at most.
        """
        made = self._http.json("POST", f"{path_of(Matte, matte)}/links", json={"days": days})
        if "path" not in made:
            raise foreign()
        return self._http.url_of(made["path"])

    def export(
        self, matte: Matte | str, file: Path, *, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Write a matte's archive to a file, whole or not at all; to a pipe as it comes.

        Parameters
        ----------
        progress : callable, optional
            Is called with the bytes received, and with all there are.
        """
        _download.whole(self._http, f"{path_of(Matte, matte)}/archive", file, progress)

    def import_matte(
        self, file: Path, *, name: str = "", progress: Callable[[int, int], None] | None = None
    ) -> Matte:
        """Import a matte from an archive.

        Parameters
        ----------
        name : str
            A name for people; by default that of the file, without its end.
        progress : callable, optional
            Is called with the bytes sent, and with all there are. The service checks them after the last.
        """
        size = state_of(file).st_size
        headers = {"Content-Type": "application/zip", "Content-Length": str(size)} | _key()

        def body() -> Iterator[bytes]:
            return _parts(file, size, progress)

        return self._matte(
            self._http.json(
                "POST",
                Matte.path,
                computing=True,
                params={"name": (name or file.stem[:200]).encode(errors="replace").decode()},
                headers=headers,
                content=body,
            )
        )

    def _matte(self, answer: dict[str, Any]) -> Matte:
        return Matte.of(answer, layers=Layers(lambda name: self.layer(answer["id"], name)))


def _region(region: tuple[int, int, int, int]) -> dict[str, int]:
    try:
        return dict(zip(("x", "y", "width", "height"), region, strict=True))
    except (TypeError, ValueError) as error:
        raise ValueError(f"a region is (x, y, width, height) in pixels, and not {region!r}") from error


def _key() -> dict[str, str]:
    """A new Idempotency-Key: a retry of the request gets the answer of the first."""
    return {"Idempotency-Key": secrets.token_hex(16)}


def _parts(file: Path, size: int, progress: Callable[[int, int], None] | None = None) -> Iterator[bytes]:
    """Read as much of a file as was announced, piece by piece."""
    with file.open("rb") as source:
        while source.tell() < size:
            data = source.read(min(SENT, size - source.tell()))
            if not data:
                raise FileChanged
            yield data
            if progress:
                progress(source.tell(), size)
