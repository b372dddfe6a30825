"""The dispatcher: submits tiles of jobs to dask, one or several a task, and collects their outcomes.

Its methods never wait for the cluster, except for results that are already there. A thread of its own holds the
connection, reconnects whenever it is lost, and watches the workers. Tiles that were under way on a lost connection are
reported as gone. dask's own callbacks are only hints to look.
"""

import logging
import threading
import time
from collections.abc import Callable, Container, Iterable, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from types import TracebackType
from typing import Any, Self

from distributed import Client, Future
from distributed.scheduler import KilledWorker

from services.cluster.task import key_of, run
from storage.cluster_state import ClusterState, WorkerState
from storage.errors import EnvmatteError
from workflows.jobs import Steps, Task

logger = logging.getLogger(__name__)

POLL = 1.0
"""Seconds between two polls of the cluster."""
ANSWER = 5.0
"""Seconds that the scheduler has to answer."""
POLL_SHARE = 0.05
"""The share of its time that it polls for, at most: a poll of a thousand workers takes long."""
LONGEST_PAUSE = 5.0
"""Seconds between two polls at most, however long one takes."""
MEMORY = "worker-restart-memory"
"""The topic under which a nanny reports to the scheduler that it ends its worker for taking too much memory."""


@dataclass(frozen=True)
class Outcome:
    """What became of a tile that was submitted.

    Attributes
    ----------
    job : str
    tile : int
    done : (float, object), optional
        What `workflows.jobs.run` returned.
    error : Exception, optional
        What the tile raised.
    died : str, optional
        The address of the worker that died while working on it.
    starved : bool
        Whether that worker was ended because it exceeded its memory limit.

    Notes
    -----
    With none of these the tile is gone through no fault of its own: with its worker, its scheduler or the connection.
    """

    job: str
    tile: int
    done: tuple[float, Any] | None = None
    error: Exception | None = None
    died: str | None = None
    starved: bool = False


@dataclass
class Flight:
    """A task under way, of tiles done one after another; ``number`` is its place in the order of submission.

    The results of its tiles come before its future ends.
    """

    job: str
    tiles: Sequence[int]
    number: int
    future: Future | None = None
    done: dict[int, tuple[float, Any]] = field(default_factory=dict)

    @property
    def ended(self) -> bool:
        return self.future is not None and self.future.done()

    @property
    def left(self) -> list[int]:
        """Tiles without a result; the first of them runs, or was the last to run."""
        return [tile for tile in self.tiles if tile not in self.done]


class Dispatcher:
    """Submits tiles to a dask cluster.

    Parameters
    ----------
    connect : callable
        Returns a synchronous client, or raises within seconds.
    store : str
        URL of the object store that workers read and write.
    scale : callable, optional
        Is called with the number of tiles to do, if workers of the cluster can be started and stopped.
    installation : str, optional
        What workers recognise the store by, see `storage.objects.marker`.
    """

    def __init__(
        self,
        connect: Callable[[], Client],
        store: str,
        scale: Callable[[int], None] | None = None,
        installation: str | None = None,
    ) -> None:
        self._connect = connect
        self._store = store
        self._scale = scale
        self._installation = installation
        self._client: Client | None = None
        self._flights: dict[str, Flight] = {}
        """By the keys of their dask tasks."""
        self._number = count()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="dispatcher")
        self.news = threading.Event()
        """Set when a tile may have an outcome, or the cluster may have changed."""
        self.cluster: ClusterState = {"workers": [], "problem": "the scheduler has not been reached yet"}
        """As last seen."""

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
        """Number of threads of all workers."""
        return _threads_of(self.cluster)

    @property
    def free(self) -> int:
        """How many more tasks the cluster can take: it gets one for each thread.

        No task waits there. So the next job is chosen when a thread is free, and a worker that dies had just the task
        that it worked on.
        """
        return (
            self.threads - sum(not flight.ended for flight in self._flights.values()) if self._usable() else 0
        )

    def submit(
        self, steps: Steps, task: Task, tiles: Sequence[Sequence[int]], trace: str | None = None
    ) -> bool:
        """Submit tiles of a job, by the task that does them; `collect` returns their outcomes.

        Parameters
        ----------
        trace : str, optional
            What they are part of.

        Returns
        -------
        bool
            False if the connection to the scheduler is being lost.
        """
        client = self._usable()
        if client is None:
            return False
        flights = {
            key_of(steps.kind, task.job, some[0]): Flight(task.job, some, next(self._number))
            for some in tiles
        }
        self._flights |= flights  # before a result may come
        what = {
            "steps": steps,
            "store": self._store,
            "installation": self._installation,
            "task": task,
            "trace": trace,
            "topic": _topic_of(client),
        }
        try:
            # By default tasks submitted within 100 ms run in any order; `_blamed` relies on the order of submission.
            futures = client.map(run, tiles, key=list(flights), pure=False, fifo_timeout="0 ms", **what)
        except Exception as error:
            logger.warning("can't submit tiles: %r", error)
            for key in flights:
                del self._flights[key]
            return False
        for flight, future in zip(flights.values(), futures, strict=True):
            flight.future = future
            future.add_done_callback(lambda _: self.news.set())
        return True

    def under_way(self, job: str) -> int:
        """How many tiles of a job the cluster works on."""
        return sum(len(flight.tiles) for flight in self._flights.values() if flight.job == job)

    def drop(self, job: str) -> None:
        """Cancel the tasks of a job; workers end those that run (`services.cluster.worker_preload`)."""
        dropped = [key for key, flight in self._flights.items() if flight.job == job]
        futures = [self._flights.pop(key).future for key in dropped]
        client = self._usable()
        if client is not None and futures:
            with suppress(Exception):  # if the client is being lost, they are released with it
                client.cancel(futures, force=True)

    def collect(self) -> list[Outcome]:
        """The outcomes of tiles since the last call."""
        ended = [self._flights.pop(key) for key, flight in list(self._flights.items()) if flight.ended]
        outcomes, dead = [], []
        for flight in ended:
            outcomes += [Outcome(flight.job, tile, done=done) for tile, done in flight.done.items()]
            error = _error_of(flight.future)
            if isinstance(error, KilledWorker):
                dead.append((flight, error.last_worker.address))
            else:
                outcomes += _failed(flight, error=error)
        return outcomes + _blamed(dead, self._starved() if dead else ())

    def want(self, tiles: int) -> None:
        """Announce how many tiles there are to do, those under way included."""
        if self._scale is not None:
            self._scale(tiles)

    def _take(self, event: tuple[float, dict[str, Any]]) -> None:
        """Keep the result of a tile that is still under way. Called in the client's thread."""
        _, sent = event
        flight = self._flights.get(sent["key"])
        if flight is not None:
            flight.done[sent["tile"]] = sent["seconds"], sent["result"]

    def _starved(self) -> set[str]:
        """The workers that were ended for their memory, as reported by their nannies to the scheduler."""
        client: Any = self._usable()
        if client is None:
            return set()
        try:
            events = client.sync(client.scheduler.events, topic=MEMORY, callback_timeout=ANSWER)
        except Exception as error:
            logger.warning("can't fetch why workers died: %r", error)
            return set()
        return {event["worker"] for _, event in events}

    def _usable(self) -> Client | None:
        client = self._client
        return client if client is not None and client.status == "running" else None

    def _watch(self) -> None:
        while True:
            start = time.monotonic()
            cluster = self._poll()
            took = time.monotonic() - start
            before, self.cluster = self.cluster, cluster
            changed = (cluster["problem"], _threads_of(cluster)) != (before["problem"], _threads_of(before))
            if changed and cluster["problem"]:
                logger.warning(cluster["problem"])
            if changed:
                self.news.set()
            if self._stopped.wait(min(max(POLL, took / POLL_SHARE), LONGEST_PAUSE)):
                return

    def _poll(self) -> ClusterState:
        """The cluster as it is now, connected to again if the connection is lost."""
        client: Any
        try:
            client = self._usable()
            if client is None:
                old, self._client = self._client, None
                if old is not None:
                    _close(old)
                client = self._connect()
            # Each time, since a client that has connected again by itself has lost it.
            client.subscribe_topic(_topic_of(client), self._take)
            self._client = client
            info = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=ANSWER)
        except EnvmatteError as error:
            return {"workers": [], "problem": error.detail}
        except Exception as error:
            return {"workers": [], "problem": f"the scheduler does not answer: {error!r}"}
        workers = [_worker(address, found) for address, found in sorted(info["workers"].items())]
        problem = None
        if not workers:
            problem = (
                "no worker is connected to the scheduler; start some with `envmatte worker`"
                if self._scale is None
                else "no worker is running; the service starts its workers itself, and if this lasts, its log says why"
            )
        under_way = sum(len(flight.tiles) for flight in list(self._flights.values()))
        return {"workers": workers, "under_way": under_way, "problem": problem}


def _topic_of(client: Client) -> str:
    """Of the events with the results of what a client submits."""
    return f"tiles-{client.id}"


def _threads_of(cluster: ClusterState) -> int:
    return sum(worker["threads"] for worker in cluster["workers"])


def _worker(address: str, found: dict[str, Any]) -> WorkerState:
    return {
        "address": address,
        "name": str(found["name"]),
        "threads": found["nthreads"],
        "memory_bytes": found["metrics"].get("memory", 0),
        "memory_limit_bytes": found["memory_limit"],
        "unconfined_decoders": found["metrics"].get("unconfined_decoders"),
    }


def _error_of(future: Future | None) -> Exception | None:
    """What a tile raised; None if it is done, or gone without an error."""
    if future is None or future.status != "error":
        return None
    try:
        error = future.exception(timeout=ANSWER)
    except (TimeoutError, CancelledError):
        return None
    except Exception as unread:  # it can't be unpickled here, but it is an error all the same
        return unread
    return error if isinstance(error, Exception) else None


def _failed(flight: Flight, **why: Any) -> list[Outcome]:
    """Outcomes of the tiles of a task that have no result: the first of them is why it ended, the others are gone."""
    return [Outcome(flight.job, tile, **(why if at == 0 else {})) for at, tile in enumerate(flight.left)]


def _blamed(dead: Iterable[tuple[Flight, str]], starved: Container[str]) -> list[Outcome]:
    """Outcomes of the tiles of dead workers: each blames the tile that it worked on.

    While workers come and go, one may have two tasks for a moment. Then the one submitted first ran.
    """
    ran: dict[str, int] = {}
    for flight, address in dead:
        if flight.left:
            ran[address] = min(flight.number, ran.get(address, flight.number))
    outcomes = []
    for flight, address in dead:
        blame = ran.get(address) == flight.number
        outcomes += _failed(flight, **({"died": address, "starved": address in starved} if blame else {}))
    return outcomes


def _close(client: Client) -> None:
    """Close a client whose scheduler may be gone."""
    with suppress(Exception):
        client.close(timeout=1)
