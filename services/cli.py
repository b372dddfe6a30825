"""The command `envmatte`.

Exit codes: 0 done; 1 the service refused or the job failed; 2 the command line was wrong; 130 interrupted.
"""

import json
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import click

from services.client import Client, ServiceError
from services.keys import keys
from services.presets import PRESETS
from services.progress import Progress
from services.running import COMMANDS, first_of

F = TypeVar("F", bound=Callable[..., Any])
KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".exr": "image/x-exr"}
"""Of pictures, by the ends of their files' names."""


def _remote(command: F) -> F:
    """Options of every command that talks to a service."""
    url = click.option(
        "--url",
        envvar="ENVMATTE_URL",
        default="http://127.0.0.1:8000",
        show_default=True,
        help="Of the service.",
    )
    key = click.option("--key", envvar="ENVMATTE_KEY", help="API key, if the service asks for one.")
    as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
    return url(key(as_json(command)))


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="envmatte")
def main() -> None:
    """Environment mattes: film glass before a monitor, put it in front of anything.

    Exit codes: 0 done; 1 the service refused or a job failed; 2 wrong command line; 130 interrupted.
    """


for command in (*COMMANDS, keys):
    main.add_command(command)


@main.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--name", default="", help="A name for people.")
@_remote
def upload(file: Path, name: str, url: str, key: str | None, as_json: bool) -> None:
    """Upload a capture and wait until it is ingested.

    Called again for the same file after an interrupt, it goes on where it stood.
    """
    with Client(url, key) as client:
        with Progress("upload") as bar:
            capture = client.upload(file, name=name, progress=lambda sent, size: bar.show(sent / size))
        with Progress("ingest") as bar:
            client.wait(capture["job"], progress=bar.job)
        _say(client.capture(capture["id"]), as_json, "id")


@main.command()
@click.argument("capture")
@click.option("--method", help="lobes or nn-dgsr.")
@click.option(
    "--option", "options", multiple=True, metavar="NAME=VALUE", help="Any option of GET /v1/options."
)
@click.option("--detach", is_flag=True, help="Print the job and do not wait for it.")
@_remote
def recover(
    capture: str,
    method: str | None,
    options: tuple[str, ...],
    detach: bool,
    url: str,
    key: str | None,
    as_json: bool,
) -> None:
    """Recover the matte of a capture, and wait for it."""
    chosen = dict(_pair(option) for option in options) | ({"method": method} if method else {})
    with Client(url, key) as client:
        job = client.recover(capture, **chosen)
        if not detach:
            with Progress("recovery") as bar:
                job = client.wait(job["id"], progress=bar.job)
    _say(job, as_json, "id" if detach else "matte")


@main.command()
@click.argument("job")
@_remote
def status(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Show a job."""
    with Client(url, key) as client:
        found = client.job(job)
    _say(found, as_json, "state", "stage", "progress")


@main.command()
@click.argument("matte")
@click.argument("backdrop", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help="PNG, JPEG or EXR to write, or MP4 of a clip, by the end of its name.",
)
@click.option("--transfer", type=click.Choice(["srgb", "linear"]), default="srgb", show_default=True)
@click.option("--right", type=float, help="The backdrop's move to the right, in widths of the monitor.")
@click.option("--down", type=float, help="Its move down, in heights of the monitor.")
@click.option("--scale", type=float, help="By how much it is larger.")
@click.option("--angle", type=float, help="By how much it is turned, in degrees, clockwise.")
@_remote
def composite(
    matte: str, backdrop: Path, output: Path, url: str, key: str | None, as_json: bool, **wanted: Any
) -> None:
    """Put a matte in front of a backdrop, a picture or a clip.

    A clip, told by its first bytes, is composited by a job, frame by frame, and written once that is done.
    """
    given = {name: value for name, value in wanted.items() if value is not None}
    ends = [".mp4"] if _is_clip(backdrop) else list(KINDS)
    if output.suffix.lower() not in ends:
        raise click.BadParameter(f"{output}: its name must end in {', '.join(ends)}", param_hint="--output")
    with Client(url, key) as client:
        if _is_clip(backdrop):
            job = client.composite_clip(matte, backdrop, **given)
            with Progress("composite") as bar:
                client.wait(job["id"], progress=bar.job)
            with _whole(output) as file:
                client.video(job["id"], file)
        else:
            kind = KINDS[output.suffix.lower()]
            _write(output, client.composite(matte, backdrop.read_bytes(), kind=kind, **given))
    _say({"output": str(output)}, as_json, "output")


def _is_clip(file: Path) -> bool:
    """Whether a file begins as MP4 and MOV do, MKV and WebM, or AVI."""
    with file.open("rb") as source:
        start = source.read(12)
    return (
        start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free")
        or start[:4] == b"\x1aE\xdf\xa3"
        or (start[:4] == b"RIFF" and start[8:] == b"AVI ")
    )


@main.command()
@click.argument("matte")
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True, help="ZIP to write."
)
@_remote
def export(matte: str, output: Path, url: str, key: str | None, as_json: bool) -> None:
    """Write a matte to a file, for `envmatte import` elsewhere or for any zarr reader."""
    with Client(url, key) as client, Progress("export") as bar:
        client.export(matte, output, progress=lambda done, size: bar.show(done / size))
    _say({"output": str(output)}, as_json, "output")


@main.command("import")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@_remote
def import_(file: Path, url: str, key: str | None, as_json: bool) -> None:
    """Bring a matte that `envmatte export` wrote; prints its id here."""
    with Client(url, key) as client, Progress("import") as bar:
        matte = client.import_matte(file, progress=lambda sent, size: bar.show(sent / size))
    _say(matte, as_json, "id")


@main.command()
@click.argument("matte")
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@_remote
def layers(matte: str, folder: Path, url: str, key: str | None, as_json: bool) -> None:
    """Write the layers of a matte for other tools to FOLDER: all.exr, stmap.exr, and 16-bit PNGs."""
    names = ("all.exr", "stmap.exr", "S.png", "rho.png", "alpha.png", "confidence.png")
    with Client(url, key) as client:
        for name in names:
            layer = client.layer(matte, name)
            folder.mkdir(parents=True, exist_ok=True)
            _write(folder / name, layer)
    _say({"folder": str(folder), "layers": names}, as_json, "folder")


@main.command()
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), default=Path("envmatte-demo.png")
)
@click.option(
    "--keep",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder to leave the capture and backdrop in.",
)
@click.option("--workers", type=int, help="Worker processes of the demo's service.")
@click.option("--url", help="Of a service that runs, to use in place of one of the demo's own.")
@click.option("--key", envvar="ENVMATTE_KEY", help="API key of that service.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
def demo(
    output: Path, keep: Path | None, workers: int | None, url: str | None, key: str | None, as_json: bool
) -> None:
    """Trace a glass ball, film it, serve, upload, recover, composite: all of it, in a picture."""
    from services.demo import run

    picture, figures = run(workers, keep, url=url, key=key)
    _write(output, picture)
    if not as_json:
        for name, value in figures.items():
            click.echo(f"{name}: {value}")
    _say({"output": str(output), **figures}, as_json, "output")


def _size(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise click.BadParameter("give it as WIDTHxHEIGHT in pixels, 1280x960 say")
    return int(found[1]), int(found[2])


@main.command(epilog="\b\nPresets:\n" + "\n".join(f"  {name:<11}{text}" for name, text in PRESETS.items()))
@click.argument("program", metavar="PROGRAM")
@click.argument("out", type=click.Path(path_type=Path), metavar="OUT")
@click.option(
    "--monitor",
    metavar="WIDTHxHEIGHT",
    callback=_size,
    help="The monitor's pixels: each of them must show one of the picture's. Left out: 1280x960 "
    "for a preset, and for a file the program's own.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.1, 30),
    default=2.0,
    show_default=True,
    help="Of a video: patterns a second.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
def patterns(program: str, out: Path, monitor: tuple[int, int] | None, rate: float, as_json: bool) -> None:
    """Write the patterns of PROGRAM, a preset or a JSON file with a program.

    \b
    OUT ending in .mp4 or .mkv: a video of them, with a border and a lead-in that make a film of it certain to
    read, and beside it the capture.json for the film. Needs a player that decodes in software, VLC or mpv say.
    Anything else: a new folder, with a PNG of each pattern, and program.json for the capture.
    """
    from pydantic import ValidationError

    from services import film
    from services import patterns as files
    from storage.errors import EnvmatteError

    video = out.suffix.lower() in film.FORMATS
    try:
        shown = files.fitted(files.given(program), monitor, bordered=video)
        with Progress("patterns") as bar:

            def progress(done: int, of: int) -> None:
                bar.show(done / of, f"{done} of {of}")

            if video:
                film.write(shown, out, rate, progress)
            else:
                files.write(shown, out, progress)
    except ValidationError as error:
        raise click.UsageError(first_of(error)) from error
    except EnvmatteError as error:
        raise click.UsageError(error.detail) from error
    except OSError as error:
        raise click.ClickException(f"{out} can't be written: {error.strerror}") from error
    kind, source = "video" if video else "folder", "preset" if program in PRESETS else "program"
    size = [shown.monitor.width, shown.monitor.height]
    _say({kind: str(out), source: program, "monitor": size, "patterns": shown.count}, as_json, kind)


def _pair(option: str) -> tuple[str, Any]:
    name, equals, value = option.partition("=")
    if not equals:
        raise click.UsageError(f"--option {option}: give it as NAME=VALUE")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def _write(path: Path, data: bytes) -> None:
    with _whole(path) as file:
        file.write(data)


@contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """A file that is written whole or not at all, so that an interrupt leaves nothing half done."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            yield file
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _say(found: dict[str, Any], as_json: bool, *names: str) -> None:
    click.echo(json.dumps(found, indent=2) if as_json else " ".join(str(found[name]) for name in names))


def run() -> None:
    """The entry point: what the service refuses becomes a message and an exit code."""
    try:
        main(standalone_mode=False)
    except ServiceError as error:
        click.echo(f"Error: {error}", err=True)
        sys.exit(1)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("Interrupted.", err=True)
        sys.exit(130)
