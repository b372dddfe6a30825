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
    quiet : float
        Seconds without trouble until it is over, where some succeed while others fail.
    """

    def __init__(self, logger: logging.Logger, quiet: float = 0.0) -> None:
        self._logger, self._quiet = logger, quiet
        self._said_at: float | None = None
        self._last = 0.0

    def goes_on(self, message: str, *arguments: object) -> None:
        """It is away now; the message says what is, and why."""
        self._last = now = time.monotonic()
        if self._said_at is None or now - self._said_at >= SAY:
            self._said_at = now  # first, for the other threads that find it away
            self._logger.warning(message, *arguments)

    def is_over(self, message: str, *arguments: object) -> None:
        """It answers, maybe as it always did."""
        if self._said_at is not None and time.monotonic() - self._last >= self._quiet:
            self._said_at = None
            self._logger.info(message, *arguments)
