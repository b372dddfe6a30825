"""Measures the processor time of quick commands and imports: `python -m tests.benchmarks.service.importing`.

Each runs in a new interpreter, with its files in the file cache. Seconds are of the CPU, in user and system mode,
including the start of the interpreter.
"""

import resource
import subprocess
import sys
import tempfile
from statistics import median

RUNS = 21
AWAY = ["--url", "http://127.0.0.1:9"]
COMMAND = ["-m", "services"]


def seconds(arguments: list[str], folder: str) -> list[float]:
    """Seconds of CPU that an interpreter takes with these arguments, for each of several runs."""
    taken = []
    for _ in range(RUNS + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *arguments], capture_output=True, cwd=folder)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return taken[1:]


def main() -> None:
    """Print them all."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, *COMMAND, "keys", "make", "lab"], cwd=folder, check=True, capture_output=True
        )
        for what, arguments in {
            "python alone": ["-c", "pass"],
            "import services.client": ["-c", "import services.client"],
            "the same, and the first Client": [
                "-c",
                "import services.client as c; c.Client('http://127.0.0.1:9')",
            ],
            "envmatte --help": [*COMMAND, "--help"],
            "envmatte serve --help": [*COMMAND, "serve", "--help"],
            "envmatte keys list": [*COMMAND, "keys", "list"],
            "envmatte status, without a service": [*COMMAND, "status", "j", *AWAY],
        }.items():
            taken = seconds(arguments, folder)
            print(
                f"{what}: {min(taken):.3f} to {max(taken):.3f} s, median {median(taken):.3f} s, of {RUNS} runs"
            )


if __name__ == "__main__":
    main()
