"""The commands of `envmatte` that make things here: patterns to show, and the demo."""

import re
from pathlib import Path

import click

from services.cli.demo import demo
from services.cli.output import as_json, example, say
from services.cli.processes import first_of
from services.cli.progress import Progress
from workflows.programs.preset_names import PRESETS


def _size(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise click.BadParameter("give it as WIDTHxHEIGHT in pixels, 1280x960 say")
    return int(found[1]), int(found[2])


@click.command(
    epilog=example(
        "envmatte patterns default patterns.mp4 --monitor 1920x1080",
        more="\b\nPresets:\n" + "\n".join(f"  {name:<11}{text}" for name, text in PRESETS.items()),
    )
)
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
@as_json
def patterns(program: str, out: Path, monitor: tuple[int, int] | None, rate: float, as_json: bool) -> None:
    """Write the patterns of PROGRAM, a preset or a JSON file with a program.

    \b
    OUT ending in .mp4 or .mkv: a video of them, with a border and a lead-in that make a film of it certain to
    read, and beside it the capture.json for the film. Needs a player that decodes in software, VLC or mpv say.
    Anything else: a new folder, with a PNG of each pattern, and program.json for the capture.
    """
    from pydantic import ValidationError

    from storage.errors import EnvmatteError
    from workflows.programs import files
    from workflows.programs import video as program_video

    video = out.suffix.lower() in program_video.FORMATS
    try:
        shown = files.fitted(files.given(program), monitor, bordered=video)
        with Progress("patterns") as bar:

            def progress(done: int, of: int) -> None:
                bar.show(done / of, f"{done} of {of}")

            if video:
                program_video.write(shown, out, rate, progress)
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
    say({kind: str(out), source: program, "monitor": size, "patterns": shown.count}, as_json, kind)


COMMANDS = (demo, patterns)
