"""The first view and the stage in Firefox."""

import asyncio
from pathlib import Path

import pytest

from tests.browser.views.firefox import FIREFOX, XVFB, opened
from tests.end_to_end.conftest import Service

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(FIREFOX is None, reason="Firefox is not installed: apt-get install firefox-esr"),
    pytest.mark.skipif(XVFB is None, reason="Firefox needs a display for WebGL: apt-get install xvfb"),
]

DRAWN = "document.querySelector('main').getAttribute('aria-busy') === 'false' && !{canvas}.hidden"
GLASS = "document.querySelector('canvas.glass')"
STAGE = "document.querySelector('.picture.stage canvas')"
TEXT = "document.querySelector('main').innerText"


def test_glass_of_the_first_view_moves(service: Service, tmp_path: Path) -> None:
    async def play() -> None:
        async with opened(tmp_path) as page:
            await page.goto(service.url)
            await page.until(DRAWN.format(canvas=GLASS))
            assert "WebGL2" not in await page.value(TEXT)
            before = await page.value(f"{GLASS}.toDataURL()")
            await page.drag(".glass-window", 120, -40)
            await page.until(f"{GLASS}.toDataURL() !== '{before}'")
            assert len(await page.screenshot()) > 50_000
            assert page.wrong == []

    asyncio.run(play())


def test_stage_is_live_and_then_exact(service: Service, ready: tuple[str, str], tmp_path: Path) -> None:
    async def play() -> None:
        async with opened(tmp_path) as page:
            await page.goto(f"{service.url}/#/mattes/{ready[1]}")
            await page.until(f"{TEXT}.includes('Checker: exact, 96 × 72 pixels')")
            await page.until(f"{TEXT}.includes('This browser draws the glass while you move')")
            await page.value(
                "void (window.seen = new Set(), new MutationObserver(() => "
                f"seen.add(/Checker: (\\w+)/.exec({TEXT})?.[1]))"
                ".observe(document.querySelector('main'), { subtree: true, childList: true, characterData: true }))"
            )
            await page.drag(".picture.stage", 100, 0)
            await page.until("location.hash.includes('right=')")
            await page.until(f"{TEXT}.includes('Checker: exact, 96 × 72 pixels')")
            assert "live" in await page.value("[...seen]")
            assert page.wrong == []

    asyncio.run(play())
