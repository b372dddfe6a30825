"""Webhooks: what is to be told when jobs have ended is sent, signed, and again until it is taken."""

import hashlib
import hmac
import http.client
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from sqlalchemy import Connection, Engine, Row

from services.settings import Settings
from services.webhooks import safe_http
from storage.database.engine import reading, writing
from storage.errors import NoRoom, NotFound, OptionError, Unavailable
from storage.records import job_log, jobs, leases, webhook_deliveries
from storage.records.leases import Superseded

logger = logging.getLogger(__name__)

POLL = 0.5
"""Seconds between two looks for what is to be sent."""
THREADS = 8
"""Requests at once: a receiver that is slow holds up one of them."""


def check(url: str | None, settings: Settings) -> None:
    """See that a URL can be a job's webhook.

    Raises
    ------
    OptionError
        If it can't, or this service sends none.
    """
    if url is None:
        return
    if settings.webhook_secret is None:
        raise OptionError(
            "this service tells no webhooks, for it has nothing to sign them with: set ENVMATTE_WEBHOOK_SECRET",
            field="webhook",
        )
    safe_http.check(url, private=settings.webhook_private)


def signature(secret: str, body: bytes, at: int) -> str:
    """The header `Envmatte-Signature`: HMAC-SHA256 of the time, a full stop, and the body.

    Parameters
    ----------
    at : int
        The time, in seconds since 1970: a receiver refuses what is old, and so what someone recorded.
    """
    digest = hmac.new(secret.encode(), f"{at}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={at},v1={digest}"


class Sender:
    """Sends what is to be sent, until it is stopped, whenever its coordinator holds the lease.

    Parameters
    ----------
    settings : Settings
        With a secret.
    engine : sqlalchemy.Engine
    token : callable
        Tells the coordinator's token, None while it holds no lease.
    """

    def __init__(self, settings: Settings, engine: Engine, token: Callable[[], int | None]) -> None:
        self._secret = settings.webhook_secret or ""
        self._private = settings.webhook_private
        self._engine = engine
        self._token = token
        self._stopped = threading.Event()
        self._under_way: set[Future[None]] = set()
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="webhook")
        self._thread = threading.Thread(target=self._run, name="webhooks")

    def __enter__(self) -> "Sender":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopped.set()
        self._thread.join()
        self._pool.shutdown(cancel_futures=True)

    def _run(self) -> None:
        while not self._stopped.wait(POLL):
            token = self._token()
            if token is None:
                continue
            try:
                self._look(token)
            except (Unavailable, NoRoom, Superseded) as error:
                logger.warning("webhooks wait: %s", error)
            except Exception:  # nothing may end this thread
                logger.exception("the webhooks go on after an error")

    def _look(self, token: int) -> None:
        self._under_way = {future for future in self._under_way if not future.done()}
        free = THREADS - len(self._under_way)
        with reading(self._engine) as c:
            if not free or not webhook_deliveries.any_due(c):
                return
        with writing(self._engine) as c:
            leases.check(c, token)
            claimed = webhook_deliveries.claim(c, free)
        for row in claimed:
            self._under_way.add(self._pool.submit(self._attempt, row))

    def _attempt(self, row: Row[Any]) -> None:
        """Send one, and write down what came of it; what can't be is tried again as if it had not been."""
        body = row.body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "envmatte",
            "Envmatte-Delivery": row.id,
            "Envmatte-Signature": signature(self._secret, body, int(time.time())),
        }
        try:
            status = safe_http.post(row.url, body, headers, private=self._private)
            taken, outcome = 200 <= status < 300, f"answered with {status}"
        except (OSError, http.client.HTTPException, ValueError) as error:
            taken, outcome = False, f"no answer: {error}"
        try:
            with writing(self._engine) as c:
                if taken:
                    webhook_deliveries.delivered(c, row.id)
                else:
                    delay = webhook_deliveries.failed(c, row.id, row.attempts)
                    outcome += "; given up" if delay is None else f"; again in {delay:.0f} s"
                _note(c, row.job, f"webhook, attempt {row.attempts}: {outcome}")
        except (Unavailable, NoRoom) as error:
            logger.warning("a webhook will be told once more: %s", error)
        except Exception:
            logger.exception("a webhook will be told once more")


def _note(connection: Connection, job: str, text: str) -> None:
    try:
        jobs.get(connection, job)
    except NotFound:  # deleted meanwhile
        return
    job_log.note(connection, job, text)
