"""An end to decoders that hang at a file: a thread can't be stopped, so its process is."""

import faulthandler
from collections.abc import Iterator
from contextlib import contextmanager

SECONDS = 180
"""More than the largest frame takes on a machine that is busy with much else, or a store that answers late."""


@contextmanager
def ended() -> Iterator[None]:
    """End this process if what is done inside takes longer than `SECONDS`, once its stacks are on stderr.

    Even where a decoder holds the interpreter, and nothing else of the process runs. A worker is started again then,
    and its tile is one that was lost. One thread at a time may be inside, as in workers.
    """
    faulthandler.dump_traceback_later(SECONDS, exit=True, file=2)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
