"""A server whose process ends in time after a signal, whatever its requests are doing."""

from types import FrameType

import uvicorn

from services.runtime.signals import end_in_time


class Server(uvicorn.Server):
    """uvicorn, which waits for the threads of requests without limit; some run native code that nothing can stop."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            end_in_time()
        super().handle_exit(sig, frame)
