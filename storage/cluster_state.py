"""The cluster as a coordinator sees it; kept as JSON beside the lease, which an earlier version may have written."""

from typing import NotRequired, TypedDict


class WorkerState(TypedDict):
    """A worker process."""

    address: str
    name: str
    threads: int
    memory_bytes: int
    memory_limit_bytes: int | None
    """None if there is no limit."""
    unconfined_decoders: str | None
    """Why its machine can't confine decoders of untrusted files; None if it can, or is not known."""


class ClusterState(TypedDict):
    """The workers of a cluster, and what is wrong with it."""

    workers: list[WorkerState]
    problem: str | None
    """A sentence; None if nothing is wrong."""
    under_way: NotRequired[int]
    """Tiles that the cluster has; missing while it does not answer."""
    without_store: NotRequired[list[str]]
    """Jobs whose tiles cannot reach the store."""


EMPTY_CLUSTER: ClusterState = {"workers": [], "problem": None}
