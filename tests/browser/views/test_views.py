"""Every view of the app, light and dark, from 390 to 2560 pixels wide: accessible, and without layout shifts."""

import json
import os
import re
import zipfile
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import PHONE, is_fitting, opened
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

WEB = Path(__file__).parents[3] / "services" / "web"
SHIFTS = """
    window.shifts = [];
    new PerformanceObserver((list) => {
        for (const entry of list.getEntries()) {
            const nodes = entry.sources.map(({ node }) => node?.className || node?.nodeName);
            if (!entry.hadRecentInput) window.shifts.push([entry.value, ...nodes]);
        }
    }).observe({ type: "layout-shift", buffered: true });
"""
MAX_SHIFT = 0.1
"""The limit of what Core Web Vitals call good."""
DEVICES: dict[str, dict[str, Any]] = {
    "desk": {"viewport": {"width": 1200, "height": 800}},
    "phone": {"viewport": PHONE, "has_touch": True, "is_mobile": True},
    "tablet": {"viewport": {"width": 820, "height": 1180}, "has_touch": True, "is_mobile": True},
    "wide": {"viewport": {"width": 2560, "height": 1440}},
}
USUAL = ("desk", "light"), ("phone", "dark")


@pytest.fixture(scope="module")
def views(service: Service, ready: tuple[str, str]) -> dict[str, tuple[str, str]]:
    """The URL of each view, and a heading that it shows."""
    capture, matte = ready
    shown = {"preset": "sketch", "monitor": {"width": 1200, "height": 800}, "border": True}
    program = service.http.post("/v1/programs", json=shown).json()["id"]
    return {
        "home": ("#/", "Tumbler"),
        "film": ("#/film", "Choose a program"),
        "program": (f"#/film/{program}", "Before you start"),
        "play": (f"v1/programs/{program}/play", "Play a program"),
        "captures": ("#/captures", "Captures"),
        "capture": (f"#/captures/{capture}", "Contact sheet"),
        "jobs": ("#/jobs", "Jobs"),
        "job": (f"#/jobs/{service.client.matte(matte)['job']}", "The frame"),
        "mattes": ("#/mattes", "Mattes"),
        "matte": (f"#/mattes/{matte}", "Layers"),
    }


def go(page: Page, service: Service, view: tuple[str, str]) -> None:
    page.goto("about:blank")  # otherwise only the part after `#` changes, and the page is not loaded
    page.goto(f"{service.url}/{view[0]}")
    expect(page.get_by_role("heading", name=view[1]).first).to_be_visible()
    if view[0].startswith("#/film/"):  # its event stream never ends
        page.wait_for_timeout(500)
    else:
        page.wait_for_load_state("networkidle")


@pytest.mark.parametrize(
    ("device", "scheme"),
    [
        pytest.param(*one, marks=() if one in USUAL else pytest.mark.exhaustive)
        for one in product(DEVICES, ("light", "dark"))
    ],
)
def test_every_view_is_accessible_and_stable(
    browser: Browser,
    service: Service,
    views: dict[str, tuple[str, str]],
    device: str,
    scheme: str,
    tmp_path: Path,
) -> None:
    folder = Path(os.environ.get("CI_ARTIFACTS") or tmp_path) / "app"
    folder.mkdir(parents=True, exist_ok=True)
    axe = Axe()
    with opened(browser, color_scheme=scheme, **DEVICES[device]) as page:
        page.add_init_script(SHIFTS)
        for name, view in views.items():
            go(page, service, view)
            assert is_fitting(page), name
            page.screenshot(path=folder / f"{name}-{device}-{scheme}.png", full_page=True)
            shifts = page.evaluate("window.shifts")
            assert sum(shift[0] for shift in shifts) < MAX_SHIFT, (name, shifts)
            found = axe.run(page).response["violations"]
            wrong = [(one["id"], [node["html"] for node in one["nodes"]]) for one in found]
            assert wrong == [], name
            if device == "desk":
                assert_tab_reaches_everything(page, name)


def test_words_of_the_player_that_come_late_shift_nothing(
    browser: Browser, service: Service, views: dict[str, tuple[str, str]]
) -> None:
    with opened(browser, **DEVICES["phone"]) as page:
        page.add_init_script(SHIFTS)
        page.route("**/words/en.js", lambda route: (page.wait_for_timeout(500), route.continue_()))
        go(page, service, views["play"])
        shifts = page.evaluate("window.shifts")
        assert sum(shift[0] for shift in shifts) < MAX_SHIFT, shifts


def assert_tab_reaches_everything(page: Page, name: str) -> None:
    expected = page.evaluate(
        """() => {
            const visible = (e) => e.checkVisibility({ visibilityProperty: true }) && !e.disabled;
            return [...document.querySelectorAll("a[href], button, input, select, summary, [tabindex='0']")]
                .filter(visible)
                .filter((e) => e.type !== "radio" || e.checked).length;
        }"""
    )
    page.evaluate("document.body.tabIndex = -1, document.body.focus()")
    reached = set()
    for _ in range(expected + 2):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("""() => [...document.querySelectorAll("*")].indexOf(document.activeElement)""")
        )
    assert len(reached) >= expected, name


def test_api_documentation_is_served_locally(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/docs")
    calls = sum(len(path) for path in service.http.get("/openapi.json").json()["paths"].values())
    expect(desk.locator(".opblock")).to_have_count(calls)
    desk.locator("#operations-captures-get_capture_v1_captures__id__get").get_by_role("button").first.click()
    expect(desk.locator(".opblock.is-open .parameters")).to_be_visible()


def test_app_is_small_and_has_a_strict_policy(service: Service, views: dict[str, tuple[str, str]]) -> None:
    files = [path for path in (WEB / "app").rglob("*") if path.is_file()]
    answers = {path: service.http.get(f"/web/{path.relative_to(WEB).as_posix()}") for path in files}
    for language in ("de", "en"):
        loaded = [one for path, one in answers.items() if "words" not in path.parts or path.stem == language]
        assert sum(one.num_bytes_downloaded for one in loaded) < 100_000
    assert sum(len(one.content) for one in loaded) < 200_000
    for path in ("/", f"/{views['play'][0]}", "/docs"):
        answer = service.http.get(path)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        for name in re.findall(r'(?:href|src)="[./]*(web/[^"]*)"', answer.text):
            file = service.http.get(f"/{name}")
            assert file.status_code == 200
            assert file.headers["cache-control"] == "no-cache"
    scripts = {
        str(path.relative_to(WEB)) for path in (WEB / "app").rglob("*.js") if "words" not in path.parts
    }
    assert scripts == set(re.findall(r"web/(app/[\w/]+\.js)", service.http.get("/").text))


def test_names_that_look_like_html_are_shown_as_text(
    desk: Page, service: Service, ball: Path, tmp_path: Path
) -> None:
    name = '<img src=x onerror="window.ran = 1">'
    renamed = tmp_path / f"{name}.zip"
    with zipfile.ZipFile(ball) as source, zipfile.ZipFile(renamed, "w") as target:
        manifest = json.loads(source.read("capture.json")) | {"name": name}
        for frame in manifest["frames"]:
            content = source.read(frame["file"])
            if frame["pattern"] == 0:  # which is no picture, so that a problem names it
                frame["file"], content = name, b"none"
            target.writestr(frame["file"], content)
        target.writestr("capture.json", json.dumps(manifest))
    uploaded = service.client.upload(renamed)
    assert uploaded["name"] == name
    until(lambda: service.client.job(uploaded["job"])["state"] == "failed")
    problem = service.client.job(uploaded["job"])["problem"]
    assert name in problem["detail"]
    for path in ("jobs", f"jobs/{uploaded['job']}", "captures", f"captures/{uploaded['id']}"):
        desk.goto(f"{service.url}/#/{path}")
        expect(desk.get_by_role("main").get_by_text(name).first).to_be_visible()
        desk.wait_for_load_state("networkidle")
        assert desk.evaluate("window.ran") is None, path
