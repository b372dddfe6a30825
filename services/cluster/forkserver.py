"""The process that workers and decoders are forked from, with what they need already imported."""

import os
from multiprocessing import forkserver

import dask
from distributed.utils import get_mp_context

PRELOAD = "services.cluster.worker_preload"
"""What a worker imports before it takes work."""
START = 60
"""Seconds that a worker may take to start on a busy machine."""
DECODING = "services.decoding.pool"
"""What a decoder of the API imports."""


def start_forkserver(*modules: str) -> None:
    """Start the fork server of this process, which imports some modules for its children.

    Otherwise every worker would import them itself: two seconds, and memory of its own. Call `configure_dask` first.
    """
    for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items():
        os.environ[name] = str(value)  # as nannies do, but before libraries that read it are loaded
    get_mp_context().set_forkserver_preload([*modules])  # replaces what distributed has set
    forkserver.ensure_running()
