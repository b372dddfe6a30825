"""`envmatte tether`: recovers a matte while a tethered camera takes the stills of a capture."""

import json
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from services.cli import options
from services.cli.output import example, print_result
from services.cli.progress import Progress
from services.cli.remote.jobs import ingest
from services.client import Capture, Client, Matte

if TYPE_CHECKING:
    from workflows.programs.program import Program

FEWEST = 8
"""Patterns that tell T in the first draft."""
LOOK = 0.5
"""Seconds between two looks at the folder. A still counts once it is as large as at the look before."""


@click.command(epilog=example("envmatte tether program.json stills --until 40"))
@click.argument("program", type=options.InputFile, metavar="PROGRAM")
@click.argument("stills", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="STILLS")
@click.option(
    "--until",
    type=float,
    metavar="DB",
    help="Stop once composites, of difficult glass too, are expected to come within this PSNR of the truth.",
)
@click.option("--name", default="", help="Name of the capture in lists.")
@options.remote
def tether(
    program: Path, stills: Path, until: float | None, name: str, url: str, key: str | None, as_json: bool
) -> None:
    """Recover a matte while a camera takes the stills of PROGRAM into the folder STILLS. Prints the matte's id.

    The first still by name shows the first pattern, and so on. From eight patterns on there is a draft, and as soon as
    that is done another one, of all stills that there are by then. The last matte is the best that they give; drafts
    are deleted once there is a better one.
    """
    from workflows.programs.files import fit_to_screen, load_program

    shown = fit_to_screen(load_program(str(program)), None, bordered=False)
    taken: Sequence[Path] = ()
    made: list[Capture | Matte] = []
    last = False
    with options.client(url, key) as client:
        while not last:
            taken = _more(stills, len(taken), shown)
            capture = _upload(client, shown, taken, name)
            quality = client.report(capture)["quality"]
            good = until is not None and quality is not None and quality["low"] >= until
            last = good or len(taken) == shown.count
            job = client.recover(capture, quality="fine" if last else "fast")
            with Progress("recovery") as bar:
                matte = client.matte(client.wait(job, progress=bar.job))
            for record in made:
                client.delete(record)
            made = [matte, capture]
            expected = f"{quality['low']:.0f} to {quality['high']:.0f} dB" if quality else "not known yet"
            place = f"{url.rstrip('/')}/#/mattes/{matte.id}"
            click.echo(
                f"{len(taken)} of {shown.count} stills, expected quality {expected}: {place}", err=True
            )
    result = {"matte": matte.id, "capture": capture.id, "stills": len(taken), "quality": quality}
    print_result(result, as_json, "matte")


def _more(folder: Path, before: int, program: "Program") -> Sequence[Path]:
    """Wait until there are more complete stills than ``before``, and enough for a matte; returns all of them."""
    sizes: dict[Path, int] = {}
    with Progress("stills") as bar:
        while True:
            now = {path: path.stat().st_size for path in sorted(folder.glob("[!.]*")) if path.is_file()}
            kinds = sorted({path.suffix.lower() for path in now})
            if len(kinds) > 1:
                raise click.UsageError(
                    f"{folder} has files of the kinds {', '.join(kinds)}: leave stills of one kind"
                )
            if len(now) > program.count:
                raise click.UsageError(f"{folder} has {len(now)} files, the program {program.count} patterns")
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
            time.sleep(LOOK)


def _upload(client: Client, program: "Program", stills: Sequence[Path], name: str) -> Capture:
    """Upload the stills of the first patterns as a capture, and wait until it is ingested."""
    from workflows.programs.files import program_json

    files = [f"{pattern:05}{still.suffix}" for pattern, still in enumerate(stills)]
    manifest = {
        "format": "envmatte-capture/1",
        "name": name,
        "program": program_json(program),
        "frames": [{"file": file, "pattern": pattern} for pattern, file in enumerate(files)],
        "unfinished": len(stills) < program.count,
    }
    with tempfile.TemporaryDirectory(prefix="envmatte-tether-") as folder:
        archive = Path(folder, "capture.zip")
        with zipfile.ZipFile(archive, "w") as target:
            target.writestr("capture.json", json.dumps(manifest))
            for file, still in zip(files, stills, strict=True):
                target.write(still, file)
        return ingest(client, archive, name)
