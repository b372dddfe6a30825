"""The commands of `envmatte` that talk to a service: a thin skin on `services.client`."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from services.cli import output as cli_output
from services.cli.output import example, say, whole, write
from services.cli.progress import Progress
from services.client import Client

F = TypeVar("F", bound=Callable[..., Any])
KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".exr": "image/x-exr"}
"""Of pictures, by the ends of their files' names."""
LAYERS = ("all.exr", "stmap.exr", "S.png", "rho.png", "alpha.png", "confidence.png")
Given = click.Path(exists=True, dir_okay=False, path_type=Path)
Written = click.Path(dir_okay=False, path_type=Path)


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
    return url(key(cli_output.as_json(command)))


def _webhook(command: F) -> F:
    return click.option("--webhook", metavar="URL", help="URL that is told when the job has ended.")(command)


def _client(url: str, key: str | None) -> Client:
    try:
        return Client(url, key)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--url") from error


@click.command(epilog=example("envmatte upload film.zip --name 'glass ball'"))
@click.argument("file", type=Given)
@click.option("--name", default="", help="A name for people.")
@_webhook
@_remote
def upload(file: Path, name: str, webhook: str | None, url: str, key: str | None, as_json: bool) -> None:
    """Upload a capture and wait until it is ingested; prints its id.

    Called again for the same file after an interrupt, it goes on where it stood.
    """
    with _client(url, key) as client:
        with Progress("upload") as bar:
            capture = client.upload(
                file, name=name, webhook=webhook, progress=lambda sent, size: bar.show(sent / size)
            )
        with Progress("ingest") as bar:
            client.wait(capture, progress=bar.job)
        say(client.capture(capture).answer, as_json, "id")


@click.command(epilog=example("envmatte recover CAPTURE --option quality=fast"))
@click.argument("capture")
@click.option("--method", help="lobes or nn-dgsr.")
@click.option(
    "--option", "options", multiple=True, metavar="NAME=VALUE", help="Any option of GET /v1/options."
)
@click.option("--detach", is_flag=True, help="Print the job and do not wait for it.")
@_webhook
@_remote
def recover(
    capture: str,
    method: str | None,
    options: tuple[str, ...],
    detach: bool,
    webhook: str | None,
    url: str,
    key: str | None,
    as_json: bool,
) -> None:
    """Recover the matte of a capture, and wait for it; prints the matte's id.

    An interrupt ends the waiting and not the job.
    """
    chosen = dict(_pair(option) for option in options) | ({"method": method} if method else {})
    with _client(url, key) as client:
        job = client.recover(capture, webhook=webhook, **chosen)
        if not detach:
            try:
                with Progress("recovery") as bar:
                    job = client.wait(job, progress=bar.job)
            except KeyboardInterrupt:
                click.echo(f"The job goes on: envmatte wait {job.id}, or envmatte cancel {job.id}", err=True)
                raise
    say(job.answer, as_json, "id" if detach else "matte")


@click.command(epilog=example("envmatte status JOB"))
@click.argument("job")
@_remote
def status(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Show a job: its state, stage and progress."""
    with _client(url, key) as client:
        say(client.job(job).answer, as_json, "state", "stage", "progress")


@click.command(epilog=example("envmatte wait JOB"))
@click.argument("job")
@_remote
def wait(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Wait until a job has ended; prints its state."""
    with _client(url, key) as client, Progress("job") as bar:
        say(client.wait(job, progress=bar.job).answer, as_json, "state")


@click.command(epilog=example("envmatte cancel JOB"))
@click.argument("job")
@_remote
def cancel(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Cancel a job; prints its state."""
    with _client(url, key) as client:
        say(client.cancel(job).answer, as_json, "state")


@click.command(epilog=example("envmatte composite MATTE backdrop.png -o composite.png"))
@click.argument("matte")
@click.argument("backdrop", type=Given)
@click.option(
    "-o",
    "--output",
    type=Written,
    required=True,
    help="PNG, JPEG or EXR to write, or MP4 of a clip, by the end of its name.",
)
@click.option("--transfer", type=click.Choice(["srgb", "linear"]), default="srgb", show_default=True)
@click.option("--right", type=float, help="The backdrop's move to the right, in widths of the monitor.")
@click.option("--down", type=float, help="Its move down, in heights of the monitor.")
@click.option("--scale", type=float, help="By how much it is larger.")
@click.option("--angle", type=float, help="By how much it is turned, in degrees, clockwise.")
@click.option("--webhook", metavar="URL", help="Of a clip: URL that is told when the job has ended.")
@_remote
def composite(
    matte: str, backdrop: Path, output: Path, url: str, key: str | None, as_json: bool, **wanted: Any
) -> None:
    """Put a matte in front of a backdrop, a picture or a clip.

    A clip, told by its first bytes, is composited by a job, frame by frame, and written once that is done; an
    interrupt cancels the job.
    """
    given = {name: value for name, value in wanted.items() if value is not None}
    ends = [".mp4"] if _is_clip(backdrop) else list(KINDS)
    if output.suffix.lower() not in ends:
        raise click.BadParameter(f"{output}: its name must end in {', '.join(ends)}", param_hint="--output")
    with _client(url, key) as client:
        if _is_clip(backdrop):
            _composite_clip(client, matte, backdrop, output, given)
        else:
            kind = KINDS[output.suffix.lower()]
            write(output, client.composite(matte, backdrop, kind=kind, **given))
    say({"output": str(output)}, as_json, "output")


def _composite_clip(client: Client, matte: str, clip: Path, output: Path, wanted: dict[str, Any]) -> None:
    job = client.composite_clip(matte, clip, **wanted)
    try:
        with Progress("composite") as bar:
            client.wait(job, progress=bar.job)
    except KeyboardInterrupt:
        client.cancel(job)
        raise
    with whole(output) as file:
        client.video(job, file)


def _is_clip(file: Path) -> bool:
    """Whether a file begins as MP4 and MOV do, MKV and WebM, or AVI."""
    with file.open("rb") as source:
        start = source.read(12)
    return (
        start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free")
        or start[:4] == b"\x1aE\xdf\xa3"
        or (start[:4] == b"RIFF" and start[8:] == b"AVI ")
    )


@click.command(epilog=example("envmatte export MATTE -o matte.zip"))
@click.argument("matte")
@click.option("-o", "--output", type=Written, required=True, help="ZIP to write.")
@_remote
def export(matte: str, output: Path, url: str, key: str | None, as_json: bool) -> None:
    """Write a matte to a file, for `envmatte import` elsewhere or for any zarr reader."""
    with _client(url, key) as client, Progress("export") as bar:
        client.export(matte, output, progress=lambda done, size: bar.show(done / size))
    say({"output": str(output)}, as_json, "output")


@click.command("import", epilog=example("envmatte import matte.zip"))
@click.argument("file", type=Given)
@_remote
def import_(file: Path, url: str, key: str | None, as_json: bool) -> None:
    """Bring a matte that `envmatte export` wrote; prints its id here."""
    with _client(url, key) as client, Progress("import") as bar:
        matte = client.import_matte(file, progress=lambda sent, size: bar.show(sent / size))
    say(matte.answer, as_json, "id")


@click.command(epilog=example("envmatte layers MATTE layers"))
@click.argument("matte")
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@_remote
def layers(matte: str, folder: Path, url: str, key: str | None, as_json: bool) -> None:
    """Write the layers of a matte for other tools to FOLDER: all.exr, stmap.exr, and 16-bit PNGs.

    They are put there once all of them have come.
    """
    with _client(url, key) as client:
        client.matte(matte)  # before a folder is made
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as coming:
            for name in LAYERS:
                Path(coming, name).write_bytes(client.layer(matte, name))
            folder.mkdir(exist_ok=True)
            for name in LAYERS:
                os.replace(Path(coming, name), folder / name)
    say({"folder": str(folder), "layers": LAYERS}, as_json, "folder")


def _pair(option: str) -> tuple[str, Any]:
    name, equals, value = option.partition("=")
    if not equals:
        raise click.UsageError(f"--option {option}: give it as NAME=VALUE")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


COMMANDS = (upload, recover, status, wait, cancel, composite, export, import_, layers)
