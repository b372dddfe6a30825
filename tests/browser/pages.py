"""Pages of the app for tests, and what they must not do."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page, Route

from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

ZIP = "Choose a film, stills or a capture archive"
"""The label of the field for capture archives and films."""
MINUTE = 60_000
"""Milliseconds."""
SIZE = 96, 72
"""Width and height of the capture that tests share."""
BY_HAND = "localStorage.setItem('envmatte-recover-by-hand', '1')"
"""Recoveries do not start by themselves."""
PHONE = {"width": 390, "height": 844}
EXPECTED = (
    "the server responded with a status of",
    "net::ERR_CONNECTION_RE",
    "net::ERR_INCOMPLETE",
    "net::ERR_EMPTY",
    "GPU stall due to ReadPixels",
)
"""What the browser itself logs about error responses, broken connections, and WebGL without a graphics card."""


@contextmanager
def opened(browser: Browser, **options: Any) -> Iterator[Page]:
    """A page that fails the test if it or its popups throw, warn, break the policy or contact another host."""
    context = browser.new_context(accept_downloads=True, **options)
    wrong: list[str] = []
    hosts: set[str] = set()
    context.on("weberror", lambda thrown: wrong.append(str(thrown.error)))
    context.on(
        "console",
        lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    context.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    yield context.new_page()
    context.close()
    wrong = [text for text in wrong if not any(expected in text for expected in EXPECTED)]
    assert wrong == [], wrong  # with a message: pytest does not rewrite asserts of this file
    assert len(hosts - {""}) == 1  # blob and data URLs have no host


def phase_of(service: Service, program: str) -> str | None:
    """What the page that shows a program has reported last."""
    showing = service.http.get(f"/v1/programs/{program}").json()["showing"]
    return showing and str(showing["phase"])


def wait(page: Page, condition: Callable[[], object]) -> None:
    """Wait as `until` does, while what a page asks for reaches the test."""
    until(lambda: condition() or page.wait_for_timeout(50))


class Held:
    """Requests that a page sends from now on, with any or some methods: they wait until the test answers them."""

    def __init__(self, page: Page, url: str | re.Pattern[str], *methods: str) -> None:
        self.routes: list[Route] = []
        self._page = page
        self._methods = methods
        page.route(url, self._take)

    def _take(self, route: Route) -> None:
        if not self._methods or route.request.method in self._methods:
            self.routes.append(route)
        else:
            route.continue_()

    def next(self) -> Route:
        """The request that has waited longest, as soon as there is one."""
        wait(self._page, lambda: self.routes)
        return self.routes.pop(0)

    def release(self) -> None:
        """Let all go on that wait."""
        while self.routes:
            self.routes.pop(0).continue_()


def asks_before_closing(page: Page) -> bool:
    """Whether a page asks before it closes, and stays open if the answer is no."""
    with page.expect_event("dialog") as dialog:
        page.close(run_before_unload=True)
    dialog.value.dismiss()
    return dialog.value.type == "beforeunload"


def unfold(page: Page) -> None:
    """Open everything in a view that is folded, once there is something."""
    page.locator("main details").first.wait_for()
    page.evaluate("document.querySelectorAll('main details').forEach((one) => (one.open = true))")


def is_fitting(page: Page) -> bool:
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))
