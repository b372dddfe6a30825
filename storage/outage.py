"""Log lines about something that is away: few of them, however often it is asked for."""

import logging
import time

SAY = 30.0
"""Seconds between two log lines."""


class Outage:
    """Logs the beginning of an outage, every half minute of it, and its end.

    Parameters
    ----------
    logger : logging.Logger
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._said_at: float | None = None

    def goes_on(self, message: str, *arguments: object) -> None:
        """It is away now; the message says what is, and why."""
        now = time.monotonic()
        if self._said_at is None or now - self._said_at >= SAY:
            self._said_at = now  # first, for the other threads that find it away
            self._logger.warning(message, *arguments)

    def is_over(self, message: str, *arguments: object) -> None:
        """It answers, maybe as it always did."""
        if self._said_at is not None:
            self._said_at = None
            self._logger.info(message, *arguments)
