"""A cluster of real processes on loopback, and faults to inject."""

import hashlib
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx2
import psutil

from storage.layout import mattes
from storage.objects.store import Objects
from tests.services.cluster.clusters import started, workers

STUCK = 240.0
"""Seconds after which a job that has not ended counts as lost."""


@dataclass
class Row:
    """A line of the table of faults; seconds count from the fault to the job's end."""

    fault: str
    injected: int = 0
    lost: int = 0
    differing: int = 0
    seconds: list[float] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        ordered = sorted(self.seconds)
        middle, last = (ordered[len(ordered) // 2], ordered[-1]) if ordered else (None, None)
        return asdict(self) | {"median": middle, "longest": last}


class Rig:
    """A scheduler, two workers, and two services with a coordinator each, on one store and one database."""

    def __init__(
        self, folder: Path, database: str | None = None, store: str | None = None, **environment: str
    ) -> None:
        self.folder = folder
        self.store = store or (folder / "store").as_uri()
        self._database = database
        self._environment = environment
        self._stack = ExitStack()
        self._commands: dict[str, tuple[str, ...]] = {}
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._random = random.Random(5)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._stack = stack
            self._start_all()
            self._stack = stack.pop_all()
        return self

    def _start_all(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.cluster = cluster = f"tcp://127.0.0.1:{free_port()}"
        self.start("scheduler", "scheduler", "--port", cluster.rsplit(":", 1)[1])
        for n in range(2):
            self.start(f"worker{n}", "worker", "--cluster", cluster, "--workers", "1")
        where = ["--data", str(self.folder / "data"), "--cluster", cluster, "--store", self.store]
        if self._database is not None:
            where += ["--database", self._database]
        self._where = where
        for n in range(2):
            self.start(f"service{n}", "serve", "--port", str(free_port()), *where)
        self.urls = [url_of(self._processes[f"service{n}"]) for n in range(2)]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def start(self, name: str, *command: str) -> None:
        """Start a process, or start it again."""
        self._commands[name] = command or self._commands[name]
        log = self.folder / f"{name}.log"
        process = started(log, *self._commands[name], within=self._within(name), **self._environment)
        self._processes[name] = self._stack.enter_context(process)

    def _within(self, name: str) -> Sequence[str]:
        """Command prefix that runs a process on its own host."""
        return ()

    def kill(self, name: str) -> None:
        """Send SIGKILL to a process but not to its children."""
        self._processes[name].kill()
        self._processes[name].wait()

    def restart(self, name: str) -> None:
        """Kill a process and start it again, as a supervisor does."""
        self.kill(name)
        self.start(name)

    @contextmanager
    def api_alone(self) -> Iterator[str]:
        """A service without a coordinator; yields its URL."""
        command = ["serve", "--port", "0", *self._where]
        with started(self.folder / "api.log", *command, ENVMATTE_COORDINATE="false") as process:
            yield url_of(process)

    def workers(self) -> list[psutil.Process]:
        """The processes in which tiles are recovered."""
        names = [name for name in self._processes if name.startswith("worker")]
        return [one for name in names for one in workers(self._processes[name])]

    def log(self, name: str) -> str:
        """The log of a process."""
        return (self.folder / f"{name}.log").read_text()

    def process(self, name: str) -> psutil.Process:
        return psutil.Process(self._processes[name].pid)

    def leader(self) -> str:
        """The name of the service whose coordinator runs the jobs."""
        logs = {n: self.log(f"service{n}") for n in range(2)}
        at = {n: max(log.rfind("runs the jobs from now on"), 0) for n, log in logs.items()}
        lines = {n: logs[n][: at[n]].rsplit("\n", 1)[-1][:23] for n in at}
        return f"service{max(lines, key=lambda n: lines[n])}"

    def ask(
        self, method: str, path: str, *, at: str | None = None, repeat: bool = True, **content: Any
    ) -> httpx2.Response:
        """Send a request to the first service that answers, or to a given one."""
        end = time.monotonic() + 60
        while True:
            for url in [at] if at else self.urls:
                try:
                    answer = self._request(method, url + path, **content)
                    if answer.status_code != 503 or not repeat:
                        return answer
                except httpx2.TransportError:
                    pass
            assert time.monotonic() < end, f"{method} {path}: no service answers"
            time.sleep(0.1)

    def _request(self, method: str, url: str, **content: Any) -> httpx2.Response:
        return httpx2.request(method, url, timeout=10, **content)

    def job(self, job: str, at: str | None = None) -> dict[str, Any]:
        found: dict[str, Any] = self.ask("GET", f"/v1/jobs/{job}", at=at).json()
        return found

    def recover(self, capture: str) -> dict[str, Any]:
        made: dict[str, Any] = self.ask("POST", "/v1/jobs", json={"capture": capture}).json()
        return made

    def ended(self, job: str, seconds: float = STUCK) -> dict[str, Any]:
        """Wait for a job's end; returns the job, also if it has not ended after ``seconds``."""
        end = time.monotonic() + seconds
        while True:
            found = self.job(job)
            if found["state"] not in ("queued", "running") or time.monotonic() > end:
                return found
            time.sleep(0.05)

    def files(self, matte: str) -> dict[str, str]:
        """SHA-256 of every file of a matte."""
        return stored(Objects(self.store), mattes.path(matte))

    def names(self, matte: str) -> set[str]:
        """Every file of a matte."""
        return Objects(self.store).paths_below(mattes.path(matte))

    def disturb(
        self, fault: str, act: Callable[[], object], capture: str, expected: dict[str, str], times: int
    ) -> Row:
        """Inject a fault at random moments of jobs; returns what became of them."""
        row = Row(fault)
        for _ in range(times):
            job = self.recover(capture)
            moment = self._random.random()
            while (now := self.job(job["id"]))["progress"] < moment * 0.9 and now["state"] != "succeeded":
                time.sleep(0.01)
            start = time.monotonic()
            act()
            row.injected += 1
            found = self.ended(job["id"])
            row.seconds.append(round(time.monotonic() - start, 2))
            row.lost += found["state"] != "succeeded"
            row.differing += found["state"] == "succeeded" and self.files(job["matte"]) != expected
        return row


def stored(objects: Objects, folder: str) -> dict[str, str]:
    """SHA-256 of everything below a folder of a store, by relative name."""
    return {
        path.removeprefix(f"{folder}/"): hashlib.sha256(objects.read(path).read()).hexdigest()
        for path in sorted(objects.paths_below(folder))
    }


def freeze(process: psutil.Process) -> None:
    process.send_signal(signal.SIGSTOP)


def thaw(process: psutil.Process) -> None:
    process.send_signal(signal.SIGCONT)


def url_of(service: subprocess.Popen[str]) -> str:
    assert service.stdout is not None
    line = service.stdout.readline()
    assert " at http" in line, line
    return line.rsplit(" at ", 1)[1].strip()


def free_port() -> int:
    """A port that nothing listens on, and that no connection takes before it is used: below those given to them."""
    while True:
        with suppress(OSError):
            port = random.SystemRandom().randrange(20_000, 32_768)
            with socket.create_server(("127.0.0.1", port)):
                return port
