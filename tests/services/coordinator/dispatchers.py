"""Dispatchers that stand for a cluster, of which a test says what becomes of its tiles."""

import threading
from typing import Any

from services.cluster.dispatcher import Outcome
from storage.cluster_state import EMPTY_CLUSTER
from storage.errors import EnvmatteError


class Idle:
    """A dispatcher whose cluster has one free thread that ends no task unless a test says so."""

    free = threads = 1

    def __init__(self) -> None:
        self.news = threading.Event()
        self.cluster = EMPTY_CLUSTER
        self.submitted: list[tuple[str, int]] = []
        self.dropped: list[str] = []
        self.outcomes: list[Outcome] = []

    def want(self, tiles: int) -> None:
        pass

    def under_way(self, job: str) -> int:
        return sum(one == job for one, _ in self.submitted)

    def submit(self, steps: Any, task: Any, tiles: list[list[int]], trace: str | None = None) -> bool:
        self.submitted += [(task.job, tile) for some in tiles for tile in some]
        return True

    def collect(self) -> list[Outcome]:
        outcomes, self.outcomes = self.outcomes, []
        return outcomes

    def drop(self, job: str) -> None:
        self.dropped.append(job)


class Refusing(Idle):
    """A dispatcher with a thread for each of three tiles, whose connection is lost when they are first submitted."""

    free = threads = 3

    def __init__(self) -> None:
        super().__init__()
        self.refused: list[int] = []

    def submit(self, steps: Any, task: Any, tiles: list[list[int]], trace: str | None = None) -> bool:
        if not self.refused:
            self.refused = [tile for some in tiles for tile in some]
            return False
        return super().submit(steps, task, tiles, trace)


class Working(Idle):
    """A dispatcher whose only worker takes a second for each tile, as it says."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[str] = []

    def collect(self) -> list[Outcome]:
        ended, self.submitted = self.submitted, []
        self.done += [job for job, _ in ended]
        return [Outcome(job, tile, done=(1.0, 10 if tile >= 0 else {})) for job, tile in ended]


class Failing(Idle):
    """A dispatcher whose worker fails each tile with an error."""

    def __init__(self, error: EnvmatteError) -> None:
        super().__init__()
        self.error = error
        self.tried: list[tuple[str, int]] = []

    def collect(self) -> list[Outcome]:
        tried, self.submitted = self.submitted, []
        self.tried += tried
        return [Outcome(job, tile, error=self.error) for job, tile in tried]
