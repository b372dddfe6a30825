"""Progress for people: a bar on a terminal, plain lines elsewhere."""

import sys
from types import TracebackType
from typing import Any, Self

import click

from services.client import Job

STEP = 0.25
"""Progress between two plain lines."""


class Progress:
    """Shows the progress of one thing on standard error."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._bar: Any = None
        self._printed = -1.0

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._bar = click.progressbar(
                length=1000,
                label=self._what,
                file=sys.stderr,
                show_eta=False,
                item_show_func=lambda text: text,
            )
            self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)

    def show(self, share: float, text: str = "") -> None:
        """Show a share of 0 to 1 and what is being done."""
        if self._bar is not None:
            self._bar.update(round(share * 1000) - self._bar.pos, text)
            self._bar.render_progress()  # update alone shows no new text where the share stands still
        elif share >= self._printed + STEP or (share == 1 and self._printed < 1):
            self._printed = share
            click.echo(f"{self._what}: {share:.0%} {text}".rstrip(), err=True)

    def job(self, job: Job) -> None:
        """Show a job of the API."""
        left = f", {job.eta_seconds:.0f} s left" if job.eta_seconds else ""
        waits = f"; {job.waits_for}" if job.waits_for else ""
        self.show(
            job.progress, f"{job.stage}, {job.tiles['done']} of {job.tiles['total']} tiles{left}{waits}"
        )
