"""A server whose process ends in time after a signal, whatever its requests are doing."""

import logging
import os
import threading
from contextlib import suppress
from types import FrameType

import psutil
import uvicorn

logger = logging.getLogger(__name__)

LIMIT = 7.0
"""Seconds from the first signal to the end of the process and its children. All that is stored survives a sudden end at
any moment, as after a crash."""


class Server(uvicorn.Server):
    """uvicorn, which waits for the threads of requests without limit; some run native code that nothing can stop."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            # Listed now: those whose parent ends meanwhile are no longer below this process.
            timer = threading.Timer(LIMIT, _end, [psutil.Process().children(recursive=True)])
            timer.daemon = True  # an orderly end is usually sooner
            timer.start()
        super().handle_exit(sig, frame)


def _end(children: list[psutil.Process]) -> None:
    logger.warning("not everything has ended %g s after the signal; the process ends all the same", LIMIT)
    # Workers and decoders would notice it only some seconds later.
    for child in children:
        with suppress(psutil.NoSuchProcess):
            child.kill()
    os._exit(0)
