"""A small synchronous client of the HTTP API.

::

    from services.client import Client

    with Client("http://127.0.0.1:8000", key) as client:
        capture = client.upload("film.zip", progress=lambda sent, size: print(f"{sent / size:.0%}"))
        job = client.wait(client.recover(capture, quality="fast"))
        matte = client.matte(job)
        picture = client.composite(matte, np.ones((1080, 1920, 3), np.float32))  # linear light in, and out
        alpha = matte.layers["alpha"]

Captures, jobs and mattes are frozen records with the API's names; where one is wanted its id does too. Importing this
loads none of numpy and the like, and httpx only with the first `Client`.

Every failure is one of these, with the problem detail (RFC 9457) as ``problem``::

    ServiceError            the service refused
    ├── Unreachable         no answer came, however often it was asked
    ├── Busy                asked too often, or out of service for now; ``retry_after``
    ├── NotAllowed          no key, or one that may not do this
    ├── NotFound            no such capture, job or matte
    ├── FileChanged         a file became another one while it was sent
    └── JobFailed           a job failed or was cancelled: ``job``

What is safe to ask again is, with growing pauses, for as long as a service that had answered is away: reads, deletes,
and whatever carries an Idempotency-Key, as all does here by which something is made. A ``Retry-After`` is waited for.
"""

from services.client._client import Client
from services.client._errors import (
    Busy,
    FileChanged,
    JobFailed,
    NotAllowed,
    NotFound,
    ServiceError,
    Unreachable,
)
from services.client._records import Capture, Job, Layers, Matte

__all__ = [
    "Busy",
    "Capture",
    "Client",
    "FileChanged",
    "Job",
    "JobFailed",
    "Layers",
    "Matte",
    "NotAllowed",
    "NotFound",
    "ServiceError",
    "Unreachable",
]
