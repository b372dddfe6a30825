"""`envmatte demo`."""

from pathlib import Path

import click

from services.cli.output import as_json, example, say, write


@click.command(epilog=example("envmatte demo --keep demo"))
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
@as_json
def demo(
    output: Path, keep: Path | None, workers: int | None, url: str | None, key: str | None, as_json: bool
) -> None:
    """Trace a glass ball, film it, serve, upload, recover, composite: all of it, in a picture."""
    from services.cli.demo_run import run

    picture, figures = run(workers, keep, url=url, key=key)
    write(output, picture)
    if not as_json:
        for name, value in figures.items():
            click.echo(f"{name}: {value}")
    say({"output": str(output), **figures}, as_json, "output")
