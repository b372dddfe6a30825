"""Logs of every process, as text or JSON, with the job and tile that a line is about."""

import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType

import dask
from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

from services.runtime.process import logger
from storage.steps import step_name

TEXT = "%(asctime)s %(levelname)s %(name)s %(about)s%(message)s"


LEVELS = logging.getLevelNamesMapping()


FLOORS = ("services", "workflows", "storage")


FIELDS = {"levelname": "level", "name": "logger", "message": "message"}


_about: ContextVar[dict[str, str | int] | None] = ContextVar("about", default=None)


@contextmanager
def about(job: str, tile: int | None = None) -> Iterator[None]:
    """What is logged inside is about a job, or about a tile or a step of it, and says so."""
    found: dict[str, str | int] = {"job": job}
    if tile is not None:
        found |= {"tile": tile} if tile >= 0 else {"step": step_name(tile)}
    token = _about.set(found)
    try:
        yield
    finally:
        _about.reset(token)


def log(form: str, level: str, role: str) -> None:
    """Log to stderr; of dask only what somebody has to know. The workers that this process starts do the same.

    Parameters
    ----------
    form : str
        ``text``, or ``json`` for an object a line: ``time`` (RFC 3339), ``level``, ``logger``, ``message``,
        ``process``, ``pid``, ``exception`` if there is one, and ``job``, ``tile``, ``step`` where it is `about` one.
    level : str
        The lowest that is logged: ``DEBUG``, ``INFO``, ``WARNING``, ``ERROR``.
    role : str
        What kind of process this is.
    """
    handler = logging.StreamHandler()
    handler.addFilter(_add_about)
    handler.setFormatter(_json(role) if form == "json" else logging.Formatter(TEXT))
    # Of others no more than before: numba alone has a hundred thousand lines about compiling a kernel.
    logging.basicConfig(level=max(logging.INFO, LEVELS[level]), handlers=[handler], force=True)
    for floor in FLOORS:
        logging.getLogger(floor).setLevel(LEVELS[level])
    logging.captureWarnings(True)
    for name, one in logging.root.manager.loggerDict.items():
        # dask gives these handlers of their own as soon as it is imported.
        if isinstance(one, logging.Logger) and name.partition(".")[0] in ("distributed", "tornado", "bokeh"):
            one.handlers = [h for h in one.handlers if not isinstance(h, logging.StreamHandler)]
            one.propagate = True
    logging.getLogger("distributed").setLevel(max(logging.WARNING, LEVELS[level]))
    sys.excepthook = _ended_by
    threading.excepthook = lambda args: logger.critical(
        "thread %s ended by an error", args.thread, exc_info=args.exc_value
    )
    # A nanny hands the configuration of dask on to its worker process.
    dask.config.set({"envmatte.log": form, "envmatte.log-level": level})


def log_as_nanny_does() -> None:
    """Log in a worker process as the process that started it."""
    log(dask.config.get("envmatte.log", "text"), dask.config.get("envmatte.log-level", "INFO"), "worker")


def _json(role: str) -> logging.Formatter:
    return JsonFormatter(
        list(FIELDS),
        rename_fields=FIELDS | {"exc_info": "exception"},
        static_fields={"process": role, "pid": os.getpid()},
        reserved_attrs=[*RESERVED_ATTRS, "about", "color_message"],
        timestamp="time",
    )


def _add_about(record: logging.LogRecord) -> bool:
    found = _about.get() or {}
    record.__dict__ |= found
    record.about = "".join(f"{name}={value} " for name, value in found.items())
    return True


def _ended_by(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, Exception):
        logger.critical("ended by an error", exc_info=(kind, error, trace))
    else:
        sys.__excepthook__(kind, error, trace)
