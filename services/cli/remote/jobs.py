"""Commands for captures and jobs: upload, recover, follow."""

import json
from inspect import signature
from pathlib import Path
from typing import Any

import click

from services.cli import options
from services.cli.output import example, print_result
from services.cli.programs import is_film
from services.cli.progress import Progress
from services.client import Busy, Capture, Client, Unreachable

_webhook = click.option("--webhook", metavar="URL", help="URL to notify when the job has ended.")


def ingest(client: Client, file: Path, name: str, webhook: str | None = None) -> Capture:
    """Upload a capture and wait until it is ingested, with bars of progress."""
    with Progress("upload") as bar:
        capture = client.upload(
            file, name=name, webhook=webhook, progress=lambda sent, size: bar.show(sent / size)
        )
    with Progress("ingest") as bar:
        client.wait(capture, progress=bar.job)
    return client.capture(capture)


@click.command(epilog=example("envmatte upload film.zip --name 'glass ball'"))
@click.argument("file", type=options.InputFile)
@click.option("--name", default="", help="Name of the capture in lists.")
@_webhook
@options.remote
def upload(file: Path, name: str, webhook: str | None, url: str, key: str | None, as_json: bool) -> None:
    """Upload a capture and wait until it is ingested. Prints the capture's id.

    After an interrupt, the same command resumes the upload.
    """
    if is_film(file):
        raise click.UsageError(
            f"{file} is a film: pack it with its program first, `envmatte pack PROGRAM {file} -o film.zip`"
        )
    with options.client(url, key) as client:
        print_result(ingest(client, file, name, webhook).answer, as_json, "id")


@click.command(epilog=example("envmatte recover CAPTURE --option quality=fast"))
@click.argument("capture")
@click.option("--method", help="Recovery method: lobes or nn-dgsr.")
@click.option(
    "--option",
    "pairs",
    multiple=True,
    metavar="NAME=VALUE",
    help="Recovery option, see GET /v1/options. May be repeated.",
)
@click.option("--detach", is_flag=True, help="Print the job's id and do not wait.")
@_webhook
@options.remote
def recover(
    capture: str,
    method: str | None,
    pairs: tuple[str, ...],
    detach: bool,
    webhook: str | None,
    url: str,
    key: str | None,
    as_json: bool,
) -> None:
    """Recover the matte of a capture and wait for it. Prints the matte's id.

    An interrupt ends the waiting, but not the job.
    """
    chosen = dict(_parse_option(pair) for pair in pairs) | ({"method": method} if method else {})
    with options.client(url, key) as client:
        job = client.recover(capture, webhook=webhook, **chosen)
        if not detach:
            try:
                with Progress("recovery") as bar:
                    job = client.wait(job, progress=bar.job)
            except KeyboardInterrupt:
                click.echo(
                    f"The job continues: envmatte wait {job.id}, or envmatte cancel {job.id}",
                    err=True,
                )
                raise
            except (Unreachable, Busy):
                click.echo(f"The job continues when the service does: envmatte wait {job.id}", err=True)
                raise
    print_result(job.answer, as_json, "id" if detach else "matte")


@click.command(epilog=example("envmatte status JOB"))
@click.argument("job")
@options.remote
def status(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Show a job: its state and, until it has ended, its stage and progress."""
    with options.client(url, key) as client:
        answer = client.job(job).answer
    if as_json or answer["stage"] == answer["state"]:
        print_result(answer, as_json, "state")
    else:
        click.echo(f"{answer['state']} {answer['stage']} {answer['progress']:.0%}")


@click.command(epilog=example("envmatte wait JOB"))
@click.argument("job")
@options.remote
def wait(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Wait until a job has ended. Prints its state."""
    with options.client(url, key) as client, Progress("job") as bar:
        print_result(client.wait(job, progress=bar.job).answer, as_json, "state")


@click.command(epilog=example("envmatte pause JOB"))
@click.argument("job")
@options.remote
def pause(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Pause a job; what is under way is done. Prints its state."""
    with options.client(url, key) as client:
        print_result(client.pause(job).answer, as_json, "state")


@click.command(epilog=example("envmatte resume JOB"))
@click.argument("job")
@options.remote
def resume(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Continue a job that is paused. Prints its state."""
    with options.client(url, key) as client:
        print_result(client.resume(job).answer, as_json, "state")


@click.command(epilog=example("envmatte cancel JOB"))
@click.argument("job")
@options.remote
def cancel(job: str, url: str, key: str | None, as_json: bool) -> None:
    """Cancel a job. Prints its state."""
    with options.client(url, key) as client:
        print_result(client.cancel(job).answer, as_json, "state")


def _parse_option(option: str) -> tuple[str, Any]:
    name, equals, text = option.partition("=")
    if not equals:
        raise click.UsageError(f"--option {option}: give it as NAME=VALUE")
    if name in signature(Client.recover).parameters:
        raise click.UsageError(f"--option {option}: {name} is no option of a recovery, see GET /v1/options")
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    try:
        json.dumps((name, value), allow_nan=False, ensure_ascii=False).encode()
    except ValueError as error:
        raise click.UsageError(f"--option {option}: this can't be sent as JSON") from error
    return name, value


COMMANDS = (upload, recover, status, wait, pause, resume, cancel)
