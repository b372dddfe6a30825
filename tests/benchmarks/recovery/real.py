"""Runs a tool that scores a service on photographs by real cameras.

    python -m tests.benchmarks.recovery.real TOOL [ARGUMENT ...]

TOOL is a script that takes the URL of a service and any arguments. It uploads captures, requests composites before the
backdrops of photographs that are in none of them, and prints their PSNR.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from services.cli.demo_run import service


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tool")
    given, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder, service(Path(folder, "data"), workers=2) as url:
        sys.exit(subprocess.run([sys.executable, given.tool, url, *arguments]).returncode)


if __name__ == "__main__":
    main()
