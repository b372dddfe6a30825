"""A bucket or a folder that is away or full: how long is waited for it, and how that is told."""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

from obstore.exceptions import BaseError

from storage.errors import DISK_FULL, NoRoom, Unavailable

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

REQUESTS: "ClientConfig" = {
    "connect_timeout": timedelta(seconds=5),
    "timeout": timedelta(seconds=20),  # of a part of 8 MiB, too
    "allow_http": True,  # where AWS_ENDPOINT_URL names it, and nowhere else
}
RETRIES: "RetryConfig" = {
    "max_retries": 1000,  # it is the time that ends them
    "retry_timeout": timedelta(seconds=40),
    # Each pause is drawn between the first and the last one times the base: with less than e they don't get longer.
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=5), "base": 4},
}
"""Of what a bucket does not answer, or with an error of its own: a minute in all, with the last request."""
UNREACHABLE = re.compile(r"HTTP error|status code: (429|5\d\d)|error sending request|response body")
"""What obstore says when a bucket does not answer, or with an error of its own; it has no kind of error for that."""


@contextmanager
def translate_errors() -> Iterator[None]:
    """Turns what obstore raises, of several kinds and without a number, to `NoRoom` and `Unavailable`."""
    try:
        yield
    except (BaseError, OSError) as error:
        said = str(error).partition("\n")[0]
        if any(f"(os error {number})" in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
            raise NoRoom(DISK_FULL) from error
        if said.startswith("Generic S3 error") and UNREACHABLE.search(said):
            raise Unavailable(
                f"the store can't be reached for now; try again ({said.rpartition(' - ')[2].strip(': ')})"
            ) from error
        raise
