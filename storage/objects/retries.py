"""Time limits and retries for requests to the store, and translation of its errors."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

from obstore.exceptions import BaseError

from storage.errors import DISK_FULL, NoRoom, StoreUnavailable

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

REQUESTS: "ClientConfig" = {
    "connect_timeout": timedelta(seconds=5),
    "timeout": timedelta(seconds=20),  # also for a part of 8 MiB
    "allow_http": True,  # only if AWS_ENDPOINT_URL names such a URL
}
RETRIES: "RetryConfig" = {
    "max_retries": 1000,  # the time limit ends them
    "retry_timeout": timedelta(seconds=40),
    # Each pause is drawn between the first pause and the base times the last one: below e they would not grow.
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=5), "base": 4},
}
"""For requests that a bucket does not answer, or answers with a server error: a minute in all."""
UNREACHABLE = re.compile(
    r"HTTP error(: [a-z ]+)?|status code: (429|5\d\d)|error sending request|response body"
)
"""In messages of obstore for a bucket that does not answer, or answers with a server error; they have no own class."""
REFUSED = (
    re.compile(
        r"<Code>(NoSuchBucket|AccessDenied|InvalidAccessKeyId|SignatureDoesNotMatch|RequestTimeTooSkewed|ExpiredToken|"
        r"InvalidToken|AuthorizationHeaderMalformed)</Code>"
    ),
    re.compile(r"status code: (40[13] \w+)"),  # in answer to HEAD, which has no code
    re.compile("(incorrectly configured region)"),
)
"""The same for a bucket that does not exist or does not accept the keys; a missing object is none of them."""


@contextmanager
def translate_errors() -> Iterator[None]:
    """Translate errors of obstore, which have neither number nor specific class.

    Raises
    ------
    NoRoom
        If the disk is full.
    FileNotFoundError
        If the folder of an object is removed while it is written.
    StoreUnavailable
        If a bucket, or a service, does not answer or refuses all requests, or a folder does.
    """
    try:
        yield
    except (BaseError, OSError) as error:
        message = str(error).partition("\n")[0]
        if any(f"(os error {number})" in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
            raise NoRoom(DISK_FULL) from error
        for number in (errno.EROFS, errno.EACCES, errno.EPERM):
            if f"(os error {number})" in str(error):
                raise StoreUnavailable(
                    f"the store refuses: {os.strerror(number)}; check how its folder is mounted, and its rights"
                ) from error
        if f"(os error {errno.ENOENT})" in str(error):
            raise FileNotFoundError(errno.ENOENT, message) from error
        refused = next(filter(None, (pattern.search(str(error)) for pattern in REFUSED)), None)
        if refused is not None:
            raise StoreUnavailable(
                f"the store refuses: {refused[1]}; check its bucket's name and region, its keys and the clock"
            ) from error
        found = [match[0] for match in UNREACHABLE.finditer(message)]
        if message.startswith(("Generic S3 error", "Generic HTTP error")) and found:
            # No more than that: the message goes on with the bucket's answer.
            raise StoreUnavailable(f"the store cannot be reached; try again later ({found[-1]})") from error
        raise
