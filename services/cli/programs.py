"""Commands for programs: write the patterns that a monitor shows, pack what a camera took of them."""

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from services.cli.options import InputFile, NumberRange, OutputFile, as_json
from services.cli.output import example, print_output, print_result
from services.cli.progress import Progress
from services.decoding.first_bytes import LENGTH, is_video
from services.runtime.whole_files import open_whole
from workflows.programs.preset_names import PRESETS

if TYPE_CHECKING:
    from workflows.programs.program import Program

LAST = 9999
"""Number that cameras give a still before they count from 0 or 1 again."""
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
    type=NumberRange(0.1, 30),
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

    If OUT ends in .mp4 or .mkv, it is a video, with a border and a lead-in by which a film of it can be read, and a
    .json of the same name is written beside it, which `envmatte pack` takes with the film. Play the video with software
    decoding, as VLC and mpv can.

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


@click.command(
    epilog=example(
        "envmatte pack patterns.json film.mkv -o film.zip", "envmatte pack program.json stills -o stills.zip"
    )
)
@click.argument("program", type=InputFile, metavar="PROGRAM")
@click.argument("source", type=click.Path(exists=True, path_type=Path), metavar="STILLS|FILM")
@click.option("-o", "--output", type=OutputFile, required=True, help="Archive to write.")
@as_json
def pack(program: Path, source: Path, output: Path, as_json: bool) -> None:
    """Pack what a camera took of PROGRAM into an archive for `envmatte upload`.

    For a FILM, PROGRAM is the .json beside the video of the patterns. For a folder of STILLS it is the program.json
    beside the pictures; there is one still of each, the first by name that of the first pattern. Where the camera's
    numbers began again after 9999, the stills from there on are the last.
    """
    if source.is_dir():
        shown = shown_program(program)
        stills = stills_in(source, shown)
        if len(stills) < shown.count:
            raise _miscounted(source, len(stills), shown)
        if note := rollover(stills):
            click.echo(note, err=True)
        manifest, files = packed_stills(shown, stills)
    else:
        manifest, files = packed_film(program, source)
    with open_whole(output) as file:
        write_archive(file, {**manifest, "name": source.stem}, files)
    print_output(output, as_json)


def shown_program(file: Path) -> "Program":
    """The program in a file, as its stills show it; a usage error if there is none."""
    from storage.errors import OptionError
    from workflows.programs.files import fit_to_screen, load_program

    try:
        return fit_to_screen(load_program(str(file)), None, bordered=False)
    except OptionError as error:
        raise click.UsageError(error.detail) from error


def stills_in(folder: Path, program: "Program") -> Sequence[Path]:
    """The stills in a folder, in the order of their names but for a `rollover`; a usage error if they are of several
    kinds, or more than the patterns."""
    stills = [path for path in sorted(folder.glob("[!.]*"), key=_by_number) if path.is_file()]
    kinds = sorted({path.suffix.lower() for path in stills})
    if len(kinds) > 1:
        raise click.UsageError(
            f"{folder} has files of the kinds {', '.join(kinds)}: leave stills of one kind"
        )
    if len(stills) > program.count:
        raise _miscounted(folder, len(stills), program)
    return _in_order(stills)


def rollover(stills: Sequence[Path]) -> str | None:
    """A note on stills, as `stills_in` has them, of which the last have the first names."""
    ordered = sorted(stills, key=_by_number)
    if list(stills) == ordered:
        return None
    return f"the camera's numbers began again: {ordered[0].name} is taken as the one after {ordered[-1].name}"


def _in_order(stills: list[Path]) -> list[Path]:
    """Puts what comes after a wide gap in the numbers first, unless the times of the files say otherwise.

    The web app does the same.
    """
    numbers = [int([0, *re.findall("[0-9]+", path.stem)][-1]) for path in stills]
    gaps = [n for n in range(1, len(stills)) if numbers[n] - numbers[n - 1] > LAST / 2]
    if not gaps or numbers[-1] > LAST or stills[-1].stat().st_mtime > stills[0].stat().st_mtime:
        return stills
    return stills[gaps[0] :] + stills[: gaps[0]]


def _by_number(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Orders names by the numbers in them, as the web app does: 10 comes after 9."""
    parts = re.split(r"([0-9]+)", path.name.casefold())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts], path.name


def _miscounted(folder: Path, files: int, program: "Program") -> click.UsageError:
    return click.UsageError(
        f"{folder} has {files} files, the program {program.count} patterns: there must be one still of each"
    )


def packed_stills(program: "Program", stills: Sequence[Path]) -> tuple[dict[str, Any], dict[str, Path]]:
    """The capture.json of a program's first stills, and the files of its archive by name."""
    from workflows.programs.files import program_json

    def entry(pattern: int, still: Path) -> str:
        # The report names files as the photographer knows them, but not every name may be in an archive.
        plain = re.fullmatch(r"[\w .()+-]+", still.name)
        return f"{pattern:05}/{still.name}" if plain else f"{pattern:05}{still.suffix}"

    files = {entry(pattern, still): still for pattern, still in enumerate(stills)}
    manifest = {
        "format": "envmatte-capture/1",
        "program": program_json(program),
        "frames": [{"file": file, "pattern": pattern} for pattern, file in enumerate(files)],
    }
    return manifest, files


def packed_film(program: Path, film: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    """The capture.json of a film of a program, and the files of its archive by name; a usage error if it is of none."""
    entry = f"film{film.suffix}"
    try:
        found = json.loads(program.read_bytes())
        video = found["video"] | {"file": entry}
        float(video["patterns_per_second"])
    except (ValueError, TypeError, KeyError) as error:
        raise click.UsageError(
            f"{program} describes no film: name the .json that `envmatte patterns` wrote beside the video it made"
        ) from error
    return found | {"video": video}, {entry: film}


def write_archive(target: BinaryIO | Path, manifest: Mapping[str, Any], files: Mapping[str, Path]) -> None:
    """Write a capture archive."""
    with zipfile.ZipFile(target, "w", strict_timestamps=False) as archive:
        archive.writestr("capture.json", json.dumps(manifest))
        for name, path in files.items():
            archive.write(path, name)


def is_film(file: Path) -> bool:
    """Whether a file begins as a video does."""
    with file.open("rb") as source:
        return is_video(source.read(LENGTH))


COMMANDS = (patterns, pack)
