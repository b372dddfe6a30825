"""Pages of the app for tests, and what they may not do."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page

ZIP = "Choose a capture’s ZIP or a film"
"""The label of the field that takes captures."""
MINUTE = 60_000
"""Milliseconds."""
SIZE = 96, 72
"""Width and height of the capture that tests share."""
PHONE = {"width": 390, "height": 844}
SAID = (
    "the server responded with a status of",
    "net::ERR_CONNECTION_RE",
    "net::ERR_INCOMPLETE",
    "net::ERR_EMPTY",
    "GPU stall due to ReadPixels",
)
"""What the browser itself says of an answer that is a problem, of a line that breaks, and of WebGL without a GPU."""


@contextmanager
def opened(browser: Browser, **options: Any) -> Iterator[Page]:
    """A page that fails the test if it, or one that it opens, throws, complains, breaks its policy or asks another host
    for anything.
    """
    context = browser.new_context(accept_downloads=True, **options)
    wrong: list[str] = []
    hosts: set[str] = set()
    context.on("weberror", lambda thrown: wrong.append(str(thrown.error)))
    context.on(
        "console",
        lambda said: wrong.append(said.text) if said.type in ("error", "warning") else None,
    )
    context.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    yield context.new_page()
    context.close()
    wrong = [text for text in wrong if not any(said in text for said in SAID)]
    assert wrong == [], wrong  # in words: no test's file, so pytest does not say what it found
    assert len(hosts - {""}) == 1  # what the page made itself has none


def asks_before_it_closes(page: Page) -> bool:
    """Whether a page does, and stays where it is told to."""
    with page.expect_event("dialog") as asked:
        page.close(run_before_unload=True)
    asked.value.dismiss()
    return asked.value.type == "beforeunload"


def is_fitting(page: Page) -> bool:
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))
