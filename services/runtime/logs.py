"""Logs of every process, as text or JSON, with the job and the tile that a line is about."""

import logging
import os
import sys
import threading
from asyncio import CancelledError
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any

import dask
from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

from storage.steps import step_name
from workflows.untrusted.control_characters import escape_controls

logger = logging.getLogger(__name__)

TEXT = "%(asctime)s %(levelname)s %(name)s %(about)s%(message)s"
"""Format of a line of text."""
LEVELS = logging.getLevelNamesMapping()
PACKAGES = ("services", "workflows", "storage")
"""Our own, which log from the level that is set; other libraries from INFO at the lowest."""
LOGGED = "_is_logged"
"""Attribute of an error of a request that has been logged: the framework raises it again, for the server to log."""
FIELDS = {"levelname": "level", "name": "logger", "message": "message"}
"""Attributes of a log record in JSON, and what they are called there."""

_about: ContextVar[dict[str, str | int] | None] = ContextVar("about", default=None)


@contextmanager
def about(job: str, tile: int | None = None) -> Iterator[None]:
    """Mark all lines logged inside as being about a job, or about a tile or a step of it."""
    fields: dict[str, str | int] = {"job": job}
    if tile is not None:
        fields |= {"tile": tile} if tile >= 0 else {"step": step_name(tile)}
    token = _about.set(fields)
    try:
        yield
    finally:
        _about.reset(token)


def configure_logging(form: str, level: str, role: str) -> None:
    """Log to stderr, in this process and in the workers that it starts.

    Parameters
    ----------
    form : str
        ``text``, or ``json`` for one object per line: ``time`` (RFC 3339), ``level``, ``logger``, ``message``,
        ``process``, ``pid``, ``exception`` if there is one, and ``job``, ``tile``, ``step`` if the line is `about` one.
    level : str
        The lowest level that is logged: ``DEBUG``, ``INFO``, ``WARNING``, ``ERROR``.
    role : str
        What kind of process this is.
    """
    handler = logging.StreamHandler()
    handler.addFilter(_add_about)
    handler.setFormatter(_json(role) if form == "json" else _TextFormatter(TEXT))
    # Libraries log from INFO at the lowest: numba alone has a hundred thousand debug lines about compiling a kernel.
    logging.basicConfig(level=max(logging.INFO, LEVELS[level]), handlers=[handler], force=True)
    for package in PACKAGES:
        logging.getLogger(package).setLevel(LEVELS[level])
    logging.captureWarnings(True)
    for name, one in logging.root.manager.loggerDict.items():
        # On import dask gives these loggers handlers of their own.
        if isinstance(one, logging.Logger) and name.partition(".")[0] in ("distributed", "tornado", "bokeh"):
            one.handlers = [h for h in one.handlers if not isinstance(h, logging.StreamHandler)]
            one.propagate = True
    logging.getLogger("distributed").setLevel(max(logging.WARNING, LEVELS[level]))
    logging.getLogger("alembic").setLevel(logging.WARNING)  # it has an INFO line for every step
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    logging.getLogger("distributed.client").addFilter(_is_an_error)
    logging.getLogger("distributed.scheduler").addFilter(_is_a_failure)
    sys.excepthook = _log_uncaught
    threading.excepthook = lambda args: logger.critical(
        "thread %s ended by an error", args.thread, exc_info=args.exc_value
    )
    # A nanny passes dask's configuration on to its worker process.
    dask.config.set({"envmatte.log": form, "envmatte.log-level": level})


def configure_worker_logging() -> None:
    """Log in a worker process as the process that started it does."""
    configure_logging(
        dask.config.get("envmatte.log", "text"), dask.config.get("envmatte.log-level", "INFO"), "worker"
    )


class _TextFormatter(logging.Formatter):
    """One line for a record, indented ones for its traceback: what others sent can't look like another record."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return escape_controls(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        return "\n".join(f"  {escape_controls(line)}" for line in super().formatException(ei).split("\n"))


def _json(role: str) -> logging.Formatter:
    return JsonFormatter(
        list(FIELDS),
        rename_fields=FIELDS | {"exc_info": "exception"},
        static_fields={"process": role, "pid": os.getpid()},
        reserved_attrs=[*RESERVED_ATTRS, "about", "color_message"],
        timestamp="time",
    )


def _add_about(record: logging.LogRecord) -> bool:
    fields = _about.get() or {}
    record.__dict__ |= fields
    record.about = "".join(f"{name}={value} " for name, value in fields.items())
    return True


def _is_news(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn says more than ours: why an answer ends early, or fails, is logged where it does."""
    logged = record.exc_info and hasattr(record.exc_info[1], LOGGED)
    return not logged and "returned without completing response" not in record.getMessage()


def _is_an_error(record: logging.LogRecord) -> bool:
    """Whether a line of dask's client is about an error: closed while it looks for its scheduler, it was cancelled."""
    return not (record.exc_info and isinstance(record.exc_info[1], CancelledError))


def _is_a_failure(record: logging.LogRecord) -> bool:
    """Whether a line of dask's scheduler is about a failure: of a task whose worker died the coordinator logs more."""
    return "marked as failed because" not in str(record.msg)


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, Exception):
        logger.critical("ended by an error", exc_info=(kind, error, trace))
    else:
        sys.__excepthook__(kind, error, trace)
