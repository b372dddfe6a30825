"""The end of a server whose requests do not end, as a process of its own."""

import signal
import sys
import time

import httpx2
import pytest

from tests.parts.processes import running

SERVER = """
import time
import uvicorn
from fastapi import FastAPI
from services.api.http import shutdown
from services.runtime import signals
signals.LIMIT = 1.5
app = FastAPI()
@app.get("/")
def hang():
    print("hangs", flush=True)
    time.sleep(600)
config = uvicorn.Config(app, port=0, log_level="error", lifespan="off", timeout_graceful_shutdown=1)
with config.bind_socket() as bound:
    bound.listen()
    print(bound.getsockname()[1], flush=True)
    shutdown.Server(config).run(sockets=[bound])
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_process_ends_in_time_whatever_its_threads_are_doing(number: signal.Signals) -> None:
    with running([sys.executable, "-c", SERVER]) as process:
        assert process.stdout is not None
        url = f"http://127.0.0.1:{process.stdout.readline().strip()}"
        with pytest.raises(httpx2.ReadTimeout):
            httpx2.get(url, timeout=httpx2.Timeout(60, read=1))
        assert process.stdout.readline() == "hangs\n"
        start = time.monotonic()
        process.send_signal(number)
        process.wait(60)
        assert time.monotonic() - start < 10
