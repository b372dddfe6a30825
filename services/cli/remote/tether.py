"""`envmatte tether`: recovers a matte while a camera takes the stills of a capture, or records its film."""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from services.cli import options
from services.cli.output import example, print_result
from services.cli.programs import (
    packed_film,
    packed_stills,
    rollover,
    shown_program,
    stills_in,
    write_archive,
)
from services.cli.progress import Progress
from services.cli.remote.jobs import ingest
from services.client import Capture, Client, Job, JobFailed, ServiceError

if TYPE_CHECKING:
    from workflows.programs.program import Program

FEWEST = 8
"""Patterns that tell T in the first draft, and more of a film at least in the next."""
POLL = 0.5
"""Seconds between two polls of what the camera has taken. A still counts once it is as large as at the poll before."""
OVER = 10.0
"""Seconds after which a film that has not grown is taken as ended: recorders write every five, or more often."""


class Taken(NamedTuple):
    """What the camera has taken by now: the capture's manifest, its files by name, and whether this is all."""

    manifest: Mapping[str, Any]
    files: Mapping[str, Path]
    last: bool


@click.command(
    epilog=example(
        "envmatte tether program.json stills --until 40", "envmatte tether patterns.json film.mkv --until 40"
    )
)
@click.argument("program", type=options.InputFile, metavar="PROGRAM")
@click.argument("source", type=click.Path(exists=True, path_type=Path), metavar="STILLS|FILM")
@click.option(
    "--until",
    type=options.Number,
    metavar="DB",
    help="Stop once composites, of difficult glass too, are expected to come within this PSNR of the truth.",
)
@click.option("--name", default="", help="Name of the capture in lists.")
@options.remote
def tether(
    program: Path, source: Path, until: float | None, name: str, url: str, key: str | None, as_json: bool
) -> None:
    """Recover a matte while a camera takes the stills of PROGRAM into a folder, or records the film of it. Prints the
    matte's id.

    The first of the STILLS by name shows the first pattern, and so on. A FILM must be of a kind that can be read while
    it grows, .mkv or .webm; its PROGRAM is the .json beside the video of the patterns.

    From eight patterns on there is a draft, and as soon as that is done another one, of all that has been taken by
    then. The last matte is the best that it gives; drafts are deleted once there is a better one.
    """
    shown = shown_program(program)
    takes = _stills(source, shown, name) if source.is_dir() else _film(source, program, name)
    draft: Job | None = None
    last = False
    with options.client(url, key) as client:
        try:
            while not last:
                capture, over = _next_capture(client, takes, draft)
                report = client.report(capture)
                quality, missing = report["quality"], report["frames"]["missing"]
                good = until is not None and quality is not None and quality["low"] >= until
                last = over or good or shown.count - 1 not in missing
                if last:
                    with Progress("recovery") as bar:
                        job = client.wait(client.recover(capture, quality="fine"), progress=bar.job)
                else:
                    job = _recover_draft(client, capture)
                if draft is not None:
                    _discard(client, draft)
                draft = job
                found = shown.count - len(missing)
                expected = f"{quality['low']:.0f} to {quality['high']:.0f} dB" if quality else "not known yet"
                place = f"{url.rstrip('/')}/#/mattes/{job.matte}"
                click.echo(
                    f"{found} of {shown.count} patterns, expected quality {expected}: {place}", err=True
                )
        except BaseException:
            if draft is not None:
                # A job that stays paused would count for ever, and keep its capture from expiring.
                with suppress(ServiceError):
                    client.resume(draft)
            raise
    result = {"matte": job.matte, "capture": capture.id, "patterns": found, "quality": quality}
    print_result(result, as_json, "matte")


def _stills(folder: Path, program: "Program", name: str) -> Iterator[Taken]:
    """All stills in the folder, each time that there are more of them."""
    stills: Sequence[Path] = ()
    noted = None
    while True:
        stills = _more(folder, len(stills), program)
        note = rollover(stills)
        if note and not noted:
            click.echo(note, err=True)
        noted = noted or note
        manifest, files = packed_stills(program, stills)
        yield Taken(manifest | {"name": name, "unfinished": True}, files, len(stills) == program.count)


def _more(folder: Path, before: int, program: "Program") -> Sequence[Path]:
    """Wait until there are more complete stills than ``before``, and enough for a matte; returns all of them."""
    sizes: dict[Path, int] = {}
    with Progress("stills") as bar:
        while True:
            now = {path: path.stat().st_size for path in stills_in(folder, program)}
            complete = []
            for path, size in now.items():
                if not size or sizes.get(path) != size:
                    break
                complete.append(path)
            count = len(complete)
            bar.show(count / program.count, f"{count} of {program.count}")
            enough = program.tells(range(count)) and (program.measured < count).sum() >= FEWEST
            if count > before and (enough or count == program.count):
                return complete
            sizes = now
            time.sleep(POLL)


def _film(file: Path, program: Path, name: str) -> Iterator[Taken]:
    """The film each time that it has grown by some patterns, and once more when it has ended."""
    manifest, files = packed_film(program, file)
    manifest |= {"name": name, "unfinished": True}
    pause = FEWEST / manifest["video"]["patterns_per_second"]
    size, grew, taken, due = 0, time.monotonic(), 0, 0.0
    while True:
        now = file.stat().st_size
        if now != size:
            size, grew = now, time.monotonic()
        over = time.monotonic() - grew > OVER
        if over or (size > taken and time.monotonic() >= due):
            taken, due = size, time.monotonic() + pause
            yield Taken(manifest, files, over)
        time.sleep(POLL)


def _next_capture(client: Client, takes: Iterator[Taken], draft: Job | None) -> tuple[Capture, bool]:
    """Upload what has been taken, once it suffices for a matte; the capture, and whether that is all.

    A draft that is still being recovered pauses meanwhile.
    """
    while True:
        taken = next(takes)
        if draft is not None:
            _if_active(client.pause, draft)
        with tempfile.TemporaryDirectory(prefix="envmatte-tether-") as folder:
            archive = Path(folder, "capture.zip")
            write_archive(archive, taken.manifest, taken.files)
            try:
                return ingest(client, archive, taken.manifest["name"]), taken.last
            except JobFailed as error:
                if taken.last or "video" not in taken.manifest:
                    raise
                click.echo(f"not yet: {error}", err=True)
                client.delete(client.capture(str(error.job.capture)))


def _recover_draft(client: Client, capture: Capture) -> Job:
    """Recover a capture until all of its frame can be composited: a large one has a preview long before its end."""
    job = client.recover(capture, quality="fast")
    with Progress("recovery") as bar:
        while job.state != "succeeded":
            if job.ended:
                raise JobFailed(job)
            if job.stage == "recovering" and client.matte(job)["preview"]:
                break
            time.sleep(POLL)
            job = client.job(job)
            bar.job(job)
    return job


def _discard(client: Client, draft: Job) -> None:
    """Delete the matte of a draft, and its capture."""
    if not _if_active(client.cancel, draft):
        client.delete(client.matte(draft))
    client.delete(client.capture(str(draft.capture)))


def _if_active(change: Callable[[Job], Job], job: Job) -> bool:
    """Change a job unless it has ended; whether it was."""
    try:
        change(job)
    except ServiceError as error:
        if error.status != HTTPStatus.CONFLICT:
            raise
        return False
    return True
