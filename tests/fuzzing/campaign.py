"""Run a fuzzing target in a monitored process that also counts crashes, hangs and excessive memory.

Input N of a target depends only on its name and N, so every failure can be reproduced.
"""

import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from workflows.untrusted.limits import Limits

ROOT = str(Path(__file__).parents[2])
CPU_SECONDS, SECONDS = 10.0, 60.0
"""Limits of one execution, in processor time and in wall time: the machine may be busy."""
MEMORY = 128 << 20
"""Bytes by which one execution may grow its process: limits of parsers are a few megabytes here."""
GUARDED = 384 << 20
"""The same for guarded decoders, which have room for large films however small the limits are."""
LIMITS = Limits(unpacked=1 << 22, memory=1 << 22, frames=20_000, pixels=1 << 20)
"""Limits of the parsers."""
ADDRESSES = 6 << 30
"""Bytes of address space the process may add, so that no execution takes all memory of the machine."""
BATCH = 2000
"""Executions of one process, in all of which leaks add up."""


class Refused(Exception):
    """Raised by an execution whose input was refused as documented."""


@dataclass(frozen=True)
class Target:
    """A parser of untrusted bytes.

    Attributes
    ----------
    name : str
    make : callable
        Makes an input out of valid files.
    run : callable
        Reads an input, given an empty working folder. It returns if the input was accepted, and
        raises `Refused` if it was refused as documented; any other error is a failure.
    valid : callable, optional
        Makes the valid files: once, and outside of the monitored processes.
    quick : int
        Number of executions that take about a second.
    memory : int
        Bytes that one execution may take.
    """

    name: str
    make: Callable[[Random, Any], bytes]
    run: Callable[[bytes, Path], object]
    valid: Callable[[], Any] = tuple
    quick: int = 100
    memory: int = MEMORY

    def input(self, seed: int, valid: Any = None) -> bytes:
        """The input of a seed; `valid` are the valid files, if they exist already."""
        return self.make(Random(f"{self.name} {seed}"), valid or self.valid())


class Failure(NamedTuple):
    """A failed execution; ``kind`` is error, crash, hang or memory."""

    kind: str
    target: str
    seed: int
    what: str
    file: Path

    def __str__(self) -> str:
        again = f"python -m tests.benchmarks.service.fuzzing --target {self.target} --seed {self.seed}"
        return f"{self.target}: {self.kind}: {self.what}\n  input: {self.file}\n  again: {again}"


@dataclass
class Tally:
    """Results of the executions of a target."""

    executions: int = 0
    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    slowest_seed: int = 0
    failures: list[Failure] = field(default_factory=list)

    def count(self, kind: str) -> int:
        return sum(failure.kind == kind for failure in self.failures)


def run(
    target: Target,
    first: int,
    count: int,
    keep: Path,
    *,
    seconds: float = float("inf"),
    failures: int = 20,
    cpu: float = CPU_SECONDS,
) -> Tally:
    """Run inputs ``first`` to ``first + count - 1`` of a target.

    Parameters
    ----------
    keep : Path
        Folder for inputs that fail.
    seconds : float
        After which it stops.
    failures : int
        After which it stops.
    cpu : float
        Processor seconds that one execution may take.
    """
    valid = target.valid()
    tally, start, seed = Tally(), time.monotonic(), first
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.fuzzing.targets", "tests.fuzzing.wrong"])  # unless one runs
    if ROOT not in sys.path:  # the processes inherit it; pytest itself does not add it
        sys.path.append(ROOT)
    while seed < first + count and len(tally.failures) < failures:
        left = seconds - (time.monotonic() - start)
        if left <= 0:
            break
        with tempfile.TemporaryDirectory() as folder:
            ours, theirs = context.Pipe(duplex=False)
            upto = min(first + count, seed + BATCH)
            process = context.Process(
                target=_batch, args=(target, valid, seed, upto, left, cpu, folder, theirs)
            )
            process.start()
            theirs.close()
            seed = _watch(process, ours, target, seed, keep, tally)
    tally.seconds = time.monotonic() - start
    return tally


def _watch(process: Any, pipe: Connection, target: Target, seed: int, keep: Path, tally: Tally) -> int:
    """Receive the results of a process; returns the first seed that still has to run."""

    def failed(kind: str, what: str) -> None:
        keep.mkdir(parents=True, exist_ok=True)
        file = keep / f"{target.name}-{seed}.bin"
        file.write_bytes(target.input(seed))
        tally.failures.append(Failure(kind, target.name, seed, what, file))

    while True:
        try:
            if not pipe.poll(SECONDS):
                process.kill()
                raise EOFError
            result = pipe.recv()
        except (EOFError, ConnectionError):
            process.join()
            code = process.exitcode
            if code in (-signal.SIGPROF, -signal.SIGKILL):
                failed("hang", "it did not end")
            else:
                failed("crash", signal.Signals(-code).name if code < 0 else f"exit status {code}")
            tally.executions += 1
            return seed + 1
        if result is None:
            process.join()
            return seed
        accepted, took, failure = result
        tally.executions += 1
        tally.accepted += accepted and failure is None
        tally.refused += not accepted and failure is None
        if took > tally.slowest:
            tally.slowest, tally.slowest_seed = took, seed
        if failure is not None:
            failed(*failure)
        seed += 1


def _batch(
    target: Target,
    valid: Any,
    first: int,
    upto: int,
    seconds: float,
    cpu: float,
    folder: str,
    pipe: Connection,
) -> None:
    """Run inputs in a process, and send the result of each."""
    warnings.simplefilter("ignore")
    _silence()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_addresses() + ADDRESSES, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    give_up = time.monotonic() + seconds
    for seed in range(first, upto):
        if time.monotonic() > give_up:
            break
        data = target.input(seed, valid)
        for once_more in (True, False) if seed == first else (False,):
            began = time.perf_counter()
            signal.setitimer(signal.ITIMER_PROF, cpu)
            accepted, failure = execute(target, data, Path(folder))
            signal.setitimer(signal.ITIMER_PROF, 0)
            if once_more:  # what is loaded once does not count
                before = _peak_memory()
        took = time.perf_counter() - began
        grown = _peak_memory() - before
        if failure is None and grown > target.memory:
            failure = "memory", f"it took {grown >> 20} MB"
        pipe.send((accepted, took, failure))
        if grown > target.memory:
            break  # the peak hides later executions that take as much
    pipe.send(None)


def execute(target: Target, data: bytes, folder: Path) -> tuple[bool, tuple[str, str] | None]:
    """Run an input in this process; returns whether it was accepted, and the failure if any."""
    try:
        target.run(data, folder)
    except Refused:
        return False, None
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        message = f"{type(error).__name__}: {error}"[:300]
        return False, ("error", f"{message} ({Path(where.filename).name}:{where.lineno}, {where.name})")
    finally:
        for left in folder.iterdir():
            if left.name != KEPT:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return True, None


KEPT = "kept"
"""Name that a target may leave in its folder for the next execution."""


def _silence() -> None:
    """Discard what decoders print."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nothing, stream)


def _peak_memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def _addresses() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
