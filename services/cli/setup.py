"""The commands of `envmatte` that prepare an installation: certificates of a cluster, compiled kernels."""

from pathlib import Path

import click

from services.cli.options import as_json
from services.cli.output import example, print_summary
from services.cli.progress import Progress


@click.command(epilog=example("envmatte certs certs"))
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), metavar="DIR")
@as_json
def certs(folder: Path, as_json: bool) -> None:
    """Make the certificates of a cluster in DIR.

    Copy the folder to every host of the cluster and name it with --certs. Anyone with these certificates can run
    arbitrary code on all machines of the cluster. A complete set that is there already is kept.
    """
    from services.runtime.certificates import make

    made = make(folder)
    summary = f"{folder}: made; copy it to every host" if made else f"{folder}: exists already, and is kept"
    print_summary({"folder": str(folder), "made": made}, as_json, summary)


@click.command(epilog=example("envmatte warm"))
@as_json
def warm(as_json: bool) -> None:
    """Compile all kernels now, so that no job waits for it.

    The compiled kernels are kept in files and loaded by every later process: in the folder that NUMBA_CACHE_DIR names,
    or else beside the source, or else, where that can't be written, in the user's cache folder. They fit this machine's
    kind of processor, and this version of envmatte.
    """
    from services.runtime.kernel_cache import require_kernel_cache

    require_kernel_cache()
    from workflows.kernels import compile_kernels

    with Progress("warm") as bar:
        done = compile_kernels(bar.show)
    result = {"cache": str(done.cache), "kernels": done.kernels, "compiled": done.compiled}
    result["seconds"] = round(done.seconds, 1)
    summary = f"{done.compiled} kernels compiled in {done.seconds:.1f} s, kept in {done.cache}"
    print_summary(result, as_json, summary)


COMMANDS = (certs, warm)
