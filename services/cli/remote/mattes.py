"""Commands for mattes: composite, write layers, export, share, import."""

import os
from pathlib import Path
from typing import Any

import click

from services.cli import options
from services.cli.output import example, print_output, print_result, write
from services.cli.programs import is_film
from services.cli.progress import Progress
from services.client import Client
from services.runtime.whole_files import open_whole

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".exr": "image/x-exr"}
"""Of composites, by the ends of file names."""
LAYERS = ("all.exr", "stmap.exr", "S.png", "rho.png", "alpha.png", "confidence.png")
NODES = {
    "blender": ("lookups.exr", "blender.py"),
    "nuke": ("lookups.exr", "nuke.nk", "nuke_stmap.nk"),
    "glsl": ("matte.live", "envmatte.js", "glass.html"),
}
"""Files that make a node of a tool."""
OF_PLATE = ("stmap.exr", "blender.py", "nuke.nk", "nuke_stmap.nk")
"""Those that can take a plate of the frame."""


@click.command(epilog=example("envmatte composite MATTE backdrop.png -o composite.png"))
@click.argument("matte")
@click.argument("backdrop", type=options.InputFile)
@click.option(
    "-o",
    "--output",
    type=options.OutputFile,
    required=True,
    help="File to write: .png, .jpg or .exr; .mp4 for a clip.",
)
@click.option("--transfer", type=click.Choice(["srgb", "linear"]), default="srgb", show_default=True)
@click.option("--right", type=options.Number, help="Move the backdrop to the right, in monitor widths.")
@click.option("--down", type=options.Number, help="Move the backdrop down, in monitor heights.")
@click.option("--scale", type=options.Number, help="Scale the backdrop by this factor.")
@click.option("--angle", type=options.Number, help="Rotate the backdrop clockwise, in degrees.")
@click.option(
    "--around",
    type=click.Choice(["nothing", "backdrop"]),
    help="What to show where the matte has no object: nothing, so that a PNG is transparent, or the backdrop.",
)
@click.option(
    "--fit",
    type=click.Choice(["monitor", "frame"]),
    help="Take the backdrop for what the monitor shows, or for all that the frame sees of the monitor's plane. "
    "By default the frame with --around backdrop, else the monitor.",
)
@click.option(
    "--interval",
    is_flag=True,
    default=None,
    help="Write half the width of each pixel's 90 % interval instead, in linear light: best as .exr.",
)
@click.option("--webhook", metavar="URL", help="For a clip: URL to notify when the job has ended.")
@options.remote
def composite(
    matte: str, backdrop: Path, output: Path, url: str, key: str | None, as_json: bool, **params: Any
) -> None:
    """Put a matte in front of a backdrop, a picture or a clip.

    A clip (a video file) is composited by a job, frame by frame. An interrupt cancels the job.
    """
    given = options.drop_unset(params)
    is_clip = is_film(backdrop)
    ends = [".mp4"] if is_clip else list(MEDIA_TYPES)
    if output.suffix.lower() not in ends:
        raise click.BadParameter(f"{output}: the name must end in {', '.join(ends)}", param_hint="--output")
    with options.client(url, key) as client:
        if is_clip:
            _composite_clip(client, matte, backdrop, output, given)
        else:
            kind = MEDIA_TYPES[output.suffix.lower()]
            write(output, client.composite(matte, backdrop, kind=kind, **given))
    print_output(output, as_json)


def _composite_clip(client: Client, matte: str, clip: Path, output: Path, params: dict[str, Any]) -> None:
    job = client.composite_clip(matte, clip, **params)
    try:
        with Progress("composite") as bar:
            client.wait(job, progress=bar.job)
    except KeyboardInterrupt:
        client.cancel(job)
        raise
    with open_whole(output) as file:
        client.video(job, file)


@click.command(
    epilog=example("envmatte export MATTE -o matte.zip", "envmatte export MATTE --html -o glass.html")
)
@click.argument("matte")
@click.option("-o", "--output", type=options.OutputFile, required=True, help="File to write.")
@click.option("--html", is_flag=True, help="Write a web page that draws the glass without a service.")
@options.remote
def export(matte: str, output: Path, html: bool, url: str, key: str | None, as_json: bool) -> None:
    """Write a matte to a file, a ZIP for `envmatte import` elsewhere or any zarr reader."""
    if output.suffix.lower() in (".html", ".htm") and not html:
        raise click.UsageError(f"{output}: a web page is written with --html; without it this is a ZIP")
    with options.client(url, key) as client:
        if html:
            write(output, client.live_page(matte))
        else:
            with Progress("export") as bar:
                client.export(matte, output, progress=lambda done, size: bar.show(done / size))
    print_output(output, as_json)


@click.command(epilog=example("envmatte share MATTE", "envmatte share MATTE --days 365"))
@click.argument("matte")
@click.option("--days", type=options.NumberRange(0, 3650, min_open=True), default=30, show_default=True)
@options.remote
def share(matte: str, days: float, url: str, key: str | None, as_json: bool) -> None:
    """Make a link by which anyone can see a matte, live, without a key. Prints its URL."""
    with options.client(url, key) as client:
        print_result({"url": client.share(matte, days)}, as_json, "url")


@click.command("import", epilog=example("envmatte import matte.zip --name 'glass ball'"))
@click.argument("file", type=options.InputFile)
@click.option("--name", default="", help="Name of the matte in lists; by default that of the file.")
@options.remote
def import_(file: Path, name: str, url: str, key: str | None, as_json: bool) -> None:
    """Import a matte that `envmatte export` wrote. Prints its new id."""
    with options.client(url, key) as client, Progress("import") as bar:
        matte = client.import_matte(file, name=name, progress=lambda sent, size: bar.show(sent / size))
    print_result(matte.answer, as_json, "id")


@click.command(
    epilog=example("envmatte layers MATTE layers", "envmatte layers MATTE glass --for blender --plate")
)
@click.argument("matte")
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@click.option(
    "--for", "tool", type=click.Choice(list(NODES)), help="Write what makes a node of this tool instead."
)
@click.option(
    "--plate",
    is_flag=True,
    help="Make stmap.exr, or the node, for a plate of the frame that the glass goes over, in place of a picture that "
    "is stretched over the monitor.",
)
@options.remote
def layers(
    matte: str, folder: Path, tool: str | None, plate: bool, url: str, key: str | None, as_json: bool
) -> None:
    """Write the layers of a matte for other tools to FOLDER: all.exr, stmap.exr, and 16-bit PNGs.

    With --for they are a node that draws the glass in front of any backdrop. The files appear once all of them are
    complete.
    """
    import tempfile

    names = NODES[tool] if tool else LAYERS
    if plate and not set(names) & set(OF_PLATE):
        raise click.UsageError("--plate: web pages fit every backdrop to the frame already")
    with options.client(url, key) as client:
        client.matte(matte)  # fails before a folder is made
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as part:
            for name in names:
                Path(part, name).write_bytes(client.layer(matte, name, plate=plate and name in OF_PLATE))
            folder.mkdir(exist_ok=True)
            for name in names:
                os.replace(Path(part, name), folder / name)
    print_result({"folder": str(folder), "layers": names}, as_json, "folder")


COMMANDS = (composite, export, share, import_, layers)
