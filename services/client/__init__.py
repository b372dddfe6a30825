"""A small synchronous client of the HTTP API.

::

    from services.client import Client

    with Client("http://127.0.0.1:8000", key) as client:
        capture = client.upload("film.zip", progress=lambda sent, size: print(f"{sent / size:.0%}"))
        job = client.wait(client.recover(capture, quality="fast"))
        matte = client.matte(job)
        picture = client.composite(matte, np.ones((1080, 1920, 3), np.float32))  # linear light in, and out
        alpha = matte.layers["alpha"]

Captures, jobs and mattes are frozen records with the names of the API; wherever one is expected its id works too.
Importing this package does not load numpy; the first `Client` loads httpx.

Every failure is one of these errors, with the problem detail (RFC 9457) as ``problem``::

    ServiceError            the service refused
    ├── Unreachable         the service did not answer, in spite of retries
    ├── Busy                too many requests, or temporarily unavailable; ``retry_after``
    ├── NotAllowed          no key, or a key without permission
    ├── NotFound            no such capture, job or matte
    ├── FileChanged         a file changed while it was sent
    └── JobFailed           a job failed or was cancelled: ``job``

Wrong arguments are a `ValueError`, a key that can't be sent an `InvalidKey`, which is one.

Requests that are safe to repeat are retried with growing pauses when a service that has answered before becomes
unreachable: reads, deletes, and requests with an Idempotency-Key, which every call here that creates something has. The
client waits as long as ``Retry-After`` says.
"""

from services.client._client import Client
from services.client._errors import (
    Busy,
    FileChanged,
    InvalidKey,
    NotAllowed,
    NotFound,
    ServiceError,
    Unreachable,
)
from services.client._records import Capture, Job, JobFailed, Layers, Matte

__all__ = [
    "Busy",
    "Capture",
    "Client",
    "FileChanged",
    "InvalidKey",
    "Job",
    "JobFailed",
    "Layers",
    "Matte",
    "NotAllowed",
    "NotFound",
    "ServiceError",
    "Unreachable",
]
