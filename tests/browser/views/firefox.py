"""Firefox, which tests drive by the protocol that it speaks itself, WebDriver BiDi.

Playwright drives a Firefox of its own. It starts others by BiDi too, but makes no page in a release that lacks one of
the commands it sends, as Debian's does. Without a display Firefox has no WebGL, so it gets a virtual one.
"""

import asyncio
import base64
import json
import os
import re
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

FIREFOX, XVFB = shutil.which("firefox-esr") or shutil.which("firefox"), shutil.which("Xvfb")
SECONDS = 120.0
"""Until Firefox or a page must have done something."""
BYTES = 1 << 28
"""Of a message; a screenshot is one."""


class Page:
    """A page in Firefox; ``wrong`` has the warnings and errors that it has logged."""

    def __init__(self, socket: WebSocketClientConnection) -> None:
        self._socket, self._asked, self._context = socket, 0, ""
        self.wrong: list[str] = []

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command; returns its result."""
        self._asked += 1
        await self._socket.write_message(json.dumps({"id": self._asked, "method": method, "params": params}))
        while True:
            text = await self._socket.read_message()
            assert text is not None, "Firefox has ended"
            answer = json.loads(text)
            if answer.get("method") == "log.entryAdded" and answer["params"]["level"] in ("warn", "error"):
                self.wrong.append(answer["params"]["text"])
            if answer.get("id") == self._asked:
                assert answer["type"] == "success", answer
                return dict(answer["result"])

    async def start(self, width: int, height: int) -> None:
        await self.ask("session.new", capabilities={})
        await self.ask("session.subscribe", events=["log.entryAdded"])
        self._context = (await self.ask("browsingContext.getTree"))["contexts"][0]["context"]
        viewport = {"width": width, "height": height}
        await self.ask("browsingContext.setViewport", context=self._context, viewport=viewport)

    async def goto(self, url: str) -> None:
        await self.ask("browsingContext.navigate", context=self._context, url=url, wait="complete")

    async def value(self, expression: str) -> Any:
        """What JavaScript in the page evaluates to."""
        script = f"Promise.resolve({expression}).then((value) => JSON.stringify(value ?? null))"
        target = {"context": self._context}
        found = await self.ask("script.evaluate", expression=script, target=target, awaitPromise=True)
        assert found["type"] == "success", found
        return json.loads(found["result"]["value"])

    async def until(self, expression: str) -> None:
        """Wait until JavaScript in the page evaluates to something true."""
        async with asyncio.timeout(SECONDS):
            while not await self.value(expression):
                await asyncio.sleep(0.1)

    async def drag(self, selector: str, right: int, down: int) -> None:
        """Drag an element by its centre, with the mouse."""
        box = await self.value(f"document.querySelector('{selector}').getBoundingClientRect()")
        x, y = round(box["x"] + box["width"] / 2), round(box["y"] + box["height"] / 2)
        steps = [
            {"type": "pointerMove", "x": x, "y": y},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerMove", "x": x + right, "y": y + down, "duration": 300},
            {"type": "pointerUp", "button": 0},
        ]
        mouse = {"type": "pointer", "id": "mouse", "actions": steps}
        await self.ask("input.performActions", context=self._context, actions=[mouse])

    async def screenshot(self) -> bytes:
        """The page as PNG."""
        found = await self.ask("browsingContext.captureScreenshot", context=self._context)
        return base64.b64decode(found["data"])


@asynccontextmanager
async def opened(folder: Path, width: int = 1200, height: int = 800) -> AsyncIterator[Page]:
    """A page in a Firefox of its own, whose profile and log are kept in a folder."""
    assert FIREFOX is not None
    assert XVFB is not None
    displayed, write = os.pipe()
    screen = ("-screen", "0", f"{width + 100}x{height + 200}x24", "-nolisten", "tcp")
    display = await asyncio.create_subprocess_exec(
        XVFB, "-displayfd", str(write), *screen, pass_fds=[write], stderr=asyncio.subprocess.DEVNULL
    )
    os.close(write)
    try:
        with os.fdopen(displayed) as pipe:
            number = (await asyncio.to_thread(pipe.readline)).strip()
        log, profile = folder / "firefox.log", folder / "profile"
        profile.mkdir()
        with log.open("wb") as output:
            command = (FIREFOX, "--profile", str(profile), "--no-remote", "--remote-debugging-port", "0")
            browser = await asyncio.create_subprocess_exec(
                *command, stderr=output, stdout=output, env=os.environ | {"DISPLAY": f":{number}"}
            )
        try:
            async with asyncio.timeout(SECONDS):
                while not (found := re.search(r"BiDi listening on (\S+)", log.read_text())):
                    assert browser.returncode is None, log.read_text()
                    await asyncio.sleep(0.1)
            socket = await websocket_connect(f"{found[1]}/session", max_message_size=BYTES)
            page = Page(socket)
            await page.start(width, height)
            yield page
            socket.close()
        finally:
            browser.terminate()
            await browser.wait()
    finally:
        display.terminate()
        await display.wait()
