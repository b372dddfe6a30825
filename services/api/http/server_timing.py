"""Where the time of an answer went: the header Server-Timing."""

import time
from collections.abc import Callable
from typing import TypeVar

R = TypeVar("R")


class ServerTiming(dict[str, float]):
    """Milliseconds that the parts of an answer took."""

    def take(self, name: str, function: Callable[[], R]) -> R:
        """Call a function, and note how long it took."""
        start = time.perf_counter()
        result = function()
        self[name] = self.get(name, 0) + (time.perf_counter() - start) * 1e3
        return result

    @property
    def header(self) -> str:
        """The value of the header Server-Timing (W3C Server Timing, section 3)."""
        return ", ".join(f"{name};dur={milliseconds:.1f}" for name, milliseconds in self.items())
