"""`envmatte demo`."""

from pathlib import Path

import click

from services.cli.options import LOCAL, OutputFile, as_json, client, key
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
@click.option(
    "--workers", type=click.IntRange(1), help="Worker processes of the demo's service. Default: one per core."
)
@click.option("--url", help="URL of a running service to use instead of starting one.")
@key
@as_json
def demo(
    output: Path, keep: Path | None, workers: int | None, url: str | None, key: str | None, as_json: bool
) -> None:
    """Show everything in one picture: trace a glass ball, simulate its capture, upload, recover and composite it."""
    from services.cli.demo_run import run

    if output.suffix.lower() != ".png":
        raise click.BadParameter(f"{output}: the name must end in .png", param_hint="--output")
    with client(url or LOCAL, key):
        pass  # wrong ones are refused before a ball is traced
    picture, figures = run(workers, keep, url=url, key=key)
    write(output, picture)
    if not as_json:
        for name, value in figures.items():
            click.echo(f"{name}: {value}")
    print_result({"output": str(output), **figures}, as_json, "output")
