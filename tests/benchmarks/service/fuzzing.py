"""Fuzzes every parser of untrusted bytes: `python -m tests.benchmarks.service.fuzzing`.

    [--target NAME] … [--seconds N] [--first N] [--json FILE] [--keep FOLDER]
    --target NAME --seed N

Runs damaged files and requests (`tests/fuzzing/`) through each parser for N seconds, in monitored processes, and
prints the results: executions, inputs refused and accepted, crashes, hangs, undocumented errors, executions over their
memory limit, and the slowest execution. Inputs that fail are kept in FOLDER. Input N of a target is always the same:
`--seed` runs one of them alone in this process, for a debugger, and `--first` continues an earlier campaign. The exit
status is 1 if anything failed. With `TMPDIR` in memory, targets that store something are twice as fast.
"""

import argparse
import json
import os
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from tests.fuzzing import campaign
from tests.fuzzing.targets import ALL

COLUMNS = (
    "target",
    "executions",
    "a second",
    "refused",
    "accepted",
    "crashes",
    "hangs",
    "errors",
    "memory",
    "slowest s",
)


def main() -> int:
    targets = {target.name: target for target in ALL}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--target", action="append", choices=targets, default=[])
    parser.add_argument("--seconds", type=float, default=30, help="for each target")
    parser.add_argument("--first", type=int, default=0, help="the first input")
    parser.add_argument("--seed", type=int, help="this input alone")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir(), "envmatte-fuzzing"))
    args = parser.parse_args()
    chosen = [targets[name] for name in args.target] or list(ALL)
    if args.seed is not None:
        for target in chosen:
            with tempfile.TemporaryDirectory() as folder:
                target.run(target.input(args.seed), Path(folder))
        return 0
    print("  ".join(f"{name:>15}" for name in COLUMNS), flush=True)
    reported = {}
    for target in chosen:
        tally = campaign.run(target, args.first, sys.maxsize, args.keep, seconds=args.seconds)
        kinds = [tally.count(kind) for kind in ("crash", "hang", "error", "memory")]
        row = (
            *(
                target.name,
                tally.executions,
                round(tally.executions / tally.seconds),
                tally.refused,
                tally.accepted,
            ),
            *(*kinds, f"{tally.slowest:.2f}"),
        )
        print("  ".join(f"{value:>15}" for value in row), flush=True)
        for failure in tally.failures:
            print(failure, flush=True)
        reported[target.name] = asdict(tally)
    if args.json:
        args.json.write_text(json.dumps(reported, default=str, indent=1))
    return int(any(tally["failures"] for tally in reported.values()))


if __name__ == "__main__":
    os.environ.setdefault("SVT_LOG", "1")  # the encoder of a clip is verbose
    sys.exit(main())
