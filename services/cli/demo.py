"""`envmatte demo`."""

from pathlib import Path

import click

from services.cli.options import OutputFile, as_json, key
from services.cli.output import example, print_result, write


@click.command(epilog=example("envmatte demo --keep demo"))
@click.option(
    "-o",
    "--output",
    type=OutputFile,
    default=Path("envmatte-demo.png"),
    show_default=True,
    help="PNG to write.",
)
@click.option(
    "--keep",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder to keep the capture and the backdrop in.",
)
@click.option("--workers", type=int, help="Worker processes of the demo's service. Default: one per core.")
@click.option("--url", help="URL of a running service to use instead of starting one.")
@key
@as_json
def demo(
    output: Path, keep: Path | None, workers: int | None, url: str | None, key: str | None, as_json: bool
) -> None:
    """Show everything in one picture: trace a glass ball, simulate its capture, upload, recover and composite it."""
    from services.cli.demo_run import run

    picture, figures = run(workers, keep, url=url, key=key)
    write(output, picture)
    if not as_json:
        for name, value in figures.items():
            click.echo(f"{name}: {value}")
    print_result({"output": str(output), **figures}, as_json, "output")
