"""Measures the import of the client: `python -m tests.benchmarks.service.importing`.

Each in a new interpreter with warm file caches, minus the time of an interpreter that imports nothing.
"""

import subprocess
import sys
from statistics import median

RUNS = 21
SCRIPT = "import time; start = time.process_time(); {}; print(time.process_time() - start)"


def seconds(statement: str) -> list[float]:
    """CPU seconds of a statement, in several interpreters."""
    command = [sys.executable, "-c", SCRIPT.format(statement)]
    return [float(subprocess.check_output(command)) for _ in range(RUNS + 1)][1:]


for what, statement in (
    ("import services.client", "import services.client"),
    ("the same, and the first Client", "import services.client as c; c.Client('http://127.0.0.1:9')"),
):
    taken = seconds(statement)
    print(f"{what}: median {median(taken) * 1e3:.0f} ms, longest {max(taken) * 1e3:.0f} ms, of {RUNS}")
