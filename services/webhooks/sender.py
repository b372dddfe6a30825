"""Sends webhooks: signs what is queued when a job ends, and sends it again until the receiver accepts it."""

import http.client
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from sqlalchemy import Connection, Engine, Row

from services.runtime.webhook_signature import headers_of, signing_key
from services.settings import CoordinatorSettings
from services.webhooks import safe_http
from storage.database.engine import reading, writing
from storage.errors import NoRoom, NotFound, OptionError, Unavailable
from storage.records import jobs, leases, webhook_deliveries
from storage.records.leases import Superseded

logger = logging.getLogger(__name__)

POLL = 0.5
"""Seconds between two queries for deliveries that are due."""
LONGEST = 200
"""Characters of an error in a job's log: it may quote what the receiver answered."""
THREADS = 8
"""Requests at once, so that one slow receiver does not hold up the others."""


def check_webhook(url: str | None, settings: CoordinatorSettings) -> None:
    """Check that a URL can be a job's webhook; None is fine.

    Raises
    ------
    OptionError
        If it can't, or if the service sends no webhooks.
    """
    if url is None:
        return
    if settings.webhook_secret is None:
        raise OptionError(
            "this service sends no webhooks because it has no secret to sign them with: set ENVMATTE_WEBHOOK_SECRET",
            field="webhook",
        )
    safe_http.check_url(url, private=settings.webhook_private)


class Sender:
    """Sends the deliveries that are due, while its coordinator holds the lease; a context manager.

    Parameters
    ----------
    settings : CoordinatorSettings
        With a webhook secret.
    engine : sqlalchemy.Engine
    token : callable
        Returns the coordinator's token, None while it holds no lease.
    """

    def __init__(
        self, settings: CoordinatorSettings, engine: Engine, token: Callable[[], int | None]
    ) -> None:
        self._key = signing_key(settings.webhook_secret or "")
        self._private = settings.webhook_private
        self._engine = engine
        self._token = token
        self._stopped = threading.Event()
        self._running: set[Future[None]] = set()
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
                self._send_due(token)
            except (Unavailable, NoRoom, Superseded):  # which the coordinator and `storage.database` log
                pass
            except Exception:  # nothing may end this thread
                logger.exception("webhooks continue after an unexpected error")

    def _send_due(self, token: int) -> None:
        self._running = {future for future in self._running if not future.done()}
        free = THREADS - len(self._running)
        with reading(self._engine) as c:
            if not free or not webhook_deliveries.any_due(c):
                return
        with writing(self._engine) as c:
            leases.require_held(c, token)
            claimed = webhook_deliveries.claim(c, free)
        for row in claimed:
            self._running.add(self._pool.submit(self._attempt, row))

    def _attempt(self, row: Row[Any]) -> None:
        """Send one delivery and record the outcome; if it can't be recorded, the delivery is sent again."""
        body = row.body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "envmatte",
            **headers_of(self._key, row.id, int(time.time()), body),
        }
        try:
            status = safe_http.post(row.url, body, headers, private=self._private)
            accepted, outcome = 200 <= status < 300, f"answered with {status}"
            if 300 <= status < 400:
                outcome += ", a redirect, and none is followed"
        except (OSError, http.client.HTTPException, ValueError) as error:
            accepted, outcome = False, f"no answer: {str(error)[:LONGEST]}"
        try:
            with writing(self._engine) as c:
                if accepted:
                    webhook_deliveries.delete(c, row.id)
                else:
                    delay = webhook_deliveries.schedule_retry(c, row.id, row.attempts)
                    outcome += "; given up" if delay is None else f"; again in {delay:.0f} s"
                _note(c, row.job, f"webhook, attempt {row.attempts}: {outcome}")
        except (Unavailable, NoRoom) as error:
            logger.warning("a webhook will be sent again: %s", error)
        except Exception:
            logger.exception("a webhook will be sent again")


def _note(connection: Connection, job: str, text: str) -> None:
    try:
        jobs.get(connection, job)
    except NotFound:  # deleted since
        return
    jobs.log(connection, job, text)
