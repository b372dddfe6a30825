"""`envmatte patterns`: writes the patterns of a program as a video or as pictures."""

import re
from pathlib import Path

import click

from services.cli.options import as_json
from services.cli.output import example, print_result
from services.cli.progress import Progress
from workflows.programs.preset_names import PRESETS

OTHER_VIDEOS = {".webm", ".mov", ".avi", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".ogv", ".gif"}
"""Ends of names of videos that are not written: a folder of such a name is not what was meant."""


def _size(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise click.BadParameter("give it as WIDTHxHEIGHT in pixels, for example 1280x960")
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
    help="Size of the monitor in pixels; each must show one pixel of the picture. Default: 1280x960 "
    "for a preset, the program's own size for a file.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.1, 30),
    default=2.0,
    show_default=True,
    help="Patterns per second of a video.",
)
@click.option(
    "--grey",
    is_flag=True,
    help="Pictures of `quick` and `sketch` in black and white, as in videos: for a camera that stores JPEG or HEIC, "
    "which have colour at half the resolution.",
)
@as_json
def patterns(
    program: str, out: Path, monitor: tuple[int, int] | None, rate: float, grey: bool, as_json: bool
) -> None:
    """Write the patterns of PROGRAM, a preset or a JSON file with a program, to OUT.

    If OUT ends in .mp4 or .mkv, it is a video, with a border and a lead-in by which a film of it can be read, and the
    capture.json for that film is written beside it. Play it with software decoding, as VLC and mpv can.

    Otherwise OUT is a new folder with a PNG of each pattern, and program.json for the capture.
    """
    from storage.errors import EnvmatteError
    from workflows.programs.files import fit_to_screen, load_program, write_folder
    from workflows.programs.video import FORMATS, write_video

    if out.suffix.lower() in OTHER_VIDEOS:
        raise click.UsageError(f"{out}: a video is written as {' or '.join(FORMATS)}; pictures, to a folder")
    if grey and program not in PRESETS:
        raise click.UsageError("--grey is for presets: a program in a file has the colours that it names")
    video = out.suffix.lower() in FORMATS
    try:
        shown = fit_to_screen(load_program(program), monitor, bordered=video, grey=grey)
        with Progress("patterns") as bar:

            def progress(done: int, of: int) -> None:
                bar.show(done / of, f"{done} of {of}")

            if video:
                write_video(shown, out, rate, progress)
            else:
                write_folder(shown, out, progress)
    except EnvmatteError as error:
        raise click.UsageError(error.detail) from error
    except OSError as error:
        raise click.ClickException(f"{out} can't be written: {error.strerror}") from error
    kind, source = "video" if video else "folder", "preset" if program in PRESETS else "program"
    size = [shown.monitor.width, shown.monitor.height]
    print_result({kind: str(out), source: program, "monitor": size, "patterns": shown.count}, as_json, kind)
