"""Many dask workers in one process, of one thread each, for tiles that only sleep: `python -m ... SCHEDULER COUNT`."""

import asyncio
import sys
import tempfile
from contextlib import AsyncExitStack

import dask
from distributed import Worker

from services.cluster.dask_config import NO_DASHBOARD, configure_dask


async def run(scheduler: str, count: int) -> None:
    """Run workers until this process is killed."""
    configure_dask()
    # All would look at the same process.
    dask.config.set({"distributed.admin.system-monitor.interval": "1 h"})
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        for _ in range(count):
            worker = Worker(scheduler, nthreads=1, memory_limit=0, local_directory=folder, **NO_DASHBOARD)
            await stack.enter_async_context(worker)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(run(sys.argv[1], int(sys.argv[2])))
