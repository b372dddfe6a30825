"""What goes to dask, and what comes back: tiles of jobs, and what became of them.

Nothing here waits for the cluster, but for results that are there already: a thread of its own holds the connection,
makes it anew whenever it is lost, and looks at the workers. What was under way on a connection that is lost is
reported as gone. dask's own callbacks are taken for no more than a hint to look.
"""

import logging
import threading
from collections.abc import Callable, Container, Iterable
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from types import TracebackType
from typing import Any, Self

from distributed import Client, Future
from distributed.scheduler import KilledWorker

from services.cluster.task import key_of, run
from storage.errors import EnvmatteError
from workflows.jobs import Steps, Task

logger = logging.getLogger(__name__)

LOOK = 1.0
"""Seconds between two looks at the cluster."""
ANSWER = 5.0
"""Seconds that the scheduler has to answer, and a worker to hand over the small result of what is done."""
MEMORY = "worker-restart-memory"
"""The topic under which a nanny tells the scheduler that it ends its worker for the memory that it takes."""


@dataclass(frozen=True)
class Outcome:
    """What became of a tile.

    Attributes
    ----------
    job, tile
        Whose it is.
    done : (float, object), optional
        What `workflows.jobs.run` returned.
    error : Exception, optional
        What it raised.
    died : str, optional
        The address of the worker that died of it, as far as can be told.
    starved : bool
        Whether that worker was ended because it took more memory than it may.

    Without any of these it is gone for no fault of its own: with its worker, its scheduler or the connection.
    """

    job: str
    tile: int
    done: tuple[float, Any] | None = None
    error: Exception | None = None
    died: str | None = None
    starved: bool = False


@dataclass(frozen=True)
class Flight:
    """A tile under way: the ``number`` says in which order they were handed over."""

    job: str
    tile: int
    number: int


class Dispatcher:
    """Hands tiles to a dask cluster.

    Parameters
    ----------
    connect : callable
        Returns a synchronous client, or raises within seconds.
    store : str
        URL of the object store that workers read and write.
    scale : callable, optional
        Told how many workers are of use, where they can be had for the asking.
    """

    def __init__(
        self, connect: Callable[[], Client], store: str, scale: Callable[[int], None] | None = None
    ) -> None:
        self._connect = connect
        self._store = store
        self._scale = scale
        self._client: Client | None = None
        self._flights: dict[Future, Flight] = {}
        self._number = count()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="dispatcher")
        self.news = threading.Event()
        """Set when something may have become of a tile, or of the cluster."""
        self.cluster: dict[str, Any] = {"workers": [], "problem": "the scheduler has not been reached yet"}
        """As last seen: the ``workers``, the tiles ``under_way``, and ``problem``, what is wrong in words or None."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join()
        if self._client is not None:
            _close(self._client)

    @property
    def threads(self) -> int:
        """Of all workers."""
        return sum(worker["threads"] for worker in self.cluster["workers"])

    @property
    def free(self) -> int:
        """How many more tiles the cluster is to have: one for each thread.

        None waits there: who comes next is decided when a thread is free, and who dies is known to die of what it has.
        """
        return self.threads - sum(not future.done() for future in self._flights) if self._usable() else 0

    def submit(self, steps: Steps, task: Task, tile: int, trace: str | None = None) -> bool:
        """Hand over a tile, and the trace that it is part of; `collect` says what became of it.

        False if it can't be, because the scheduler is being lost.
        """
        client, number = self._usable(), next(self._number)
        flight = Flight(task.job, tile, number)
        if client is None:
            return False
        key = key_of(steps.kind, task.job, tile)
        # By default what is submitted within 100 ms of one another runs in any order: `_blamed` goes by this one.
        try:
            future = client.submit(
                run, steps, self._store, task, tile, trace, key=key, pure=False, fifo_timeout="0 ms"
            )
        except Exception as error:
            logger.warning("nothing can be handed over: %r", error)
            return False
        self._flights[future] = flight
        future.add_done_callback(lambda _: self.news.set())
        return True

    def under_way(self, job: str) -> int:
        """How many tiles of a job are."""
        return sum(flight.job == job for flight in self._flights.values())

    def drop(self, job: str) -> None:
        """Forget a job's tasks; its workers end those that run (`services.cluster.worker_preload`)."""
        dropped = [future for future, flight in self._flights.items() if flight.job == job]
        for future in dropped:
            del self._flights[future]
        client = self._usable()
        if client is not None and dropped:
            with suppress(Exception):  # a client that is being lost: they are released with it
                client.cancel(dropped, force=True)

    def collect(self) -> list[Outcome]:
        """What became of tiles since the last call."""
        ended = {future: self._flights.pop(future) for future in list(self._flights) if future.done()}
        if not ended:
            return []
        results = self._results([future for future in ended if future.status == "finished"])
        outcomes, dead = [], []
        for future, flight in ended.items():
            if future in results:
                outcomes.append(Outcome(flight.job, flight.tile, done=results[future]))
                continue
            error = _error_of(future)
            if isinstance(error, KilledWorker):
                dead.append((flight, error.last_worker.address))
            else:
                outcomes.append(Outcome(flight.job, flight.tile, error=error))
        return outcomes + _blamed(dead, self._starved() if dead else ())

    def want(self, tiles: int) -> None:
        """Say how many tiles there are to do, those under way included."""
        if self._scale is not None:
            self._scale(tiles)

    def _results(self, finished: list[Future]) -> dict[Future, tuple[float, Any]]:
        """The results of those that are done, as far as they can still be had."""
        client = self._usable()
        if client is None or not finished:
            return {}
        try:
            return dict(
                zip(finished, client.sync(client._gather, finished, callback_timeout=ANSWER), strict=True)
            )
        except Exception as error:  # a worker that is gone, or frozen: what it had is done again
            logger.warning("%d results can't be had: %r", len(finished), error)
            return {}

    def _starved(self) -> set[str]:
        """The workers that were ended for their memory, as far as their nannies have told the scheduler."""
        client: Any = self._usable()
        if client is None:
            return set()
        try:
            told = client.sync(client.scheduler.events, topic=MEMORY, callback_timeout=ANSWER)
        except Exception as error:
            logger.warning("what workers died of can't be had: %r", error)
            return set()
        return {event["worker"] for _, event in told}

    def _usable(self) -> Client | None:
        client = self._client
        return client if client is not None and client.status == "running" else None

    def _keep(self) -> None:
        while True:
            cluster = self._look()
            changed = cluster["problem"] != self.cluster["problem"] or self.threads != sum(
                worker["threads"] for worker in cluster["workers"]
            )
            if changed and cluster["problem"]:
                logger.warning(cluster["problem"])
            self.cluster = cluster
            if changed:
                self.news.set()
            if self._stopped.wait(LOOK):
                return

    def _look(self) -> dict[str, Any]:
        client: Any
        try:
            if self._usable() is None:
                old, self._client = self._client, None
                if old is not None:
                    _close(old)
                self._client = self._connect()
            client = self._client
            info = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=ANSWER)
        except EnvmatteError as error:
            return {"workers": [], "problem": error.detail}
        except Exception as error:
            return {"workers": [], "problem": f"the scheduler does not answer: {error!r}"}
        workers = [_worker(address, found) for address, found in sorted(info["workers"].items())]
        problem = (
            None if workers else "no worker is connected to the scheduler; start some with `envmatte worker`"
        )
        return {"workers": workers, "under_way": len(self._flights), "problem": problem}


def _worker(address: str, found: dict[str, Any]) -> dict[str, Any]:
    return {
        "address": address,
        "name": str(found["name"]),
        "threads": found["nthreads"],
        "memory_bytes": found["metrics"].get("memory", 0),
        "memory_limit_bytes": found["memory_limit"],
    }


def _error_of(future: Future) -> Exception | None:
    """What a tile raised; None if it is gone without."""
    if future.status != "error":
        return None
    try:
        error = future.exception(timeout=ANSWER)
    except (TimeoutError, CancelledError):
        return None
    except Exception as unread:  # it can't be read here: it is an error all the same
        return unread
    return error if isinstance(error, Exception) else None


def _blamed(dead: Iterable[tuple[Flight, str]], starved: Container[str] = ()) -> list[Outcome]:
    """Who is to blame for the death of a worker: the tile that it had.

    Where workers go, one may for a moment have two: then the tile that it had got first, for that one ran.
    """
    ran: dict[str, int] = {}
    for flight, address in dead:
        ran[address] = min(flight.number, ran.get(address, flight.number))
    return [
        Outcome(flight.job, flight.tile, died=address, starved=address in starved)
        if ran[address] == flight.number
        else Outcome(flight.job, flight.tile)
        for flight, address in dead
    ]


def _close(client: Client) -> None:
    """Close a client that may have nobody to say goodbye to."""
    with suppress(Exception):
        client.close(timeout=1)
