"""The app in German: every view, without an English word of its own, a key or a gap."""

import re
import zipfile
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import BY_HAND, MINUTE, PHONE, ZIP, is_fitting, opened, unfold
from tests.docs.test_app_words import WEB, phrases, words
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

ENGLISH, GERMAN, SAID = (words(WEB / "app" / "words" / name) for name in ("en.js", "de.js", "service/de.js"))
# What only English says: long enough that nothing else is the same.
PHRASES = [
    *(text for key, text in ENGLISH.items() if len(text) > 14 and "{" not in text and text != GERMAN[key]),
    *(part for text in SAID for part in phrases(text) if len(part) > 14),
]
TEXTS = """() => [
    document.body.innerText,
    ...[...document.querySelectorAll("[aria-label], [alt], [placeholder], [title]")]
        .flatMap((one) => [one.ariaLabel, one.alt, one.placeholder, one.title].filter(Boolean)),
].join("\\n")"""

DESK = {"width": 1200, "height": 800}
SAY = """async (text) => (await import("/web/app/lib/words.js")).said(text)"""


def check(page: Page, name: str) -> None:
    """Check what a view says, folded or not, and that its words fit a phone."""
    expect(page.locator("main")).to_have_attribute("aria-busy", "false")
    page.evaluate("document.querySelectorAll('main details').forEach((one) => (one.open = true))")
    text = page.evaluate(TEXTS)
    assert [phrase for phrase in PHRASES if phrase in text] == [], name
    assert [
        key for key in GERMAN if "." in key and re.search(rf"(?<![\w.]){re.escape(key)}(?![\w.])", text)
    ] == []
    assert "undefined" not in text, name
    assert not re.search(r"\{\w+\}", text), name
    page.set_viewport_size(PHONE)
    assert is_fitting(page), name
    page.set_viewport_size(DESK)


def test_every_view_speaks_german(browser: Browser, service: Service, ready: tuple[str, str]) -> None:
    capture, matte = ready
    shown = {"preset": "sketch", "monitor": {"width": 1200, "height": 800}, "border": True}
    program = service.http.post("/v1/programs", json=shown).json()["id"]
    job = service.client.matte(matte)["job"]
    views = {
        "": "Trinkglas",
        "film": "Programm wählen",
        f"film/{program}": "Vor dem Start",
        "captures": "Aufnahmen",
        f"captures/{capture}": "Kontaktbogen",
        "jobs": "Aufträge",
        f"jobs/{job}": "Berechnung einer Matte",
        "mattes": "Matten",
        f"mattes/{matte}": "Ebenen",
        "mattes/none": None,
    }
    with opened(browser, locale="de-DE", viewport=DESK) as page:
        loaded: list[str] = []
        page.on("request", lambda request: loaded.append(request.url) if "/words/" in request.url else None)
        page.goto(f"{service.url}/#/captures")
        expect(page.locator("html")).to_have_attribute("lang", "de")
        for path, heading in views.items():
            page.goto(f"{service.url}/#/{path}")
            if heading:
                expect(page.get_by_role("heading", name=heading).first).to_be_visible()
            else:
                expect(page.get_by_role("alert")).to_contain_text("gelöscht")
            check(page, path)
        page.goto(f"{service.url}/#/mattes/{matte}")
        expect(page.get_by_text(re.compile("^Karos: exakt, 96 × 72 Pixel"))).to_be_visible()
        unfold(page)
        page.get_by_role("button", name="Pixel erklären").click()
        expect(page.get_by_text(re.compile(r"^Pixel \(48, 36\): .*\d %"))).to_be_visible()
        check(page, "a pixel")
        page.goto(f"{service.url}/v1/programs/{program}/play")
        expect(page.get_by_role("status")).to_have_text("Bereit.", timeout=MINUTE)
        expect(page.get_by_role("button", name="Im Vollbild abspielen")).to_be_enabled()
        text = page.evaluate(TEXTS)
        assert [phrase for phrase in PHRASES if phrase in text] == []
        assert {url.rpartition("/")[2] for url in loaded} == {"de.js"}


def test_report_is_read_in_german(browser: Browser, service: Service, ready: tuple[str, str]) -> None:
    report = service.http.get(f"/v1/captures/{ready[0]}/report").json()
    said = [one[key] for one in report["findings"] for key in ("message", "remedy")]
    assert len(said) > 10
    with opened(browser, locale="de-DE", viewport={"width": 1200, "height": 800}) as page:
        page.goto(f"{service.url}/#/captures/{ready[0]}")
        findings = page.locator(".findings li")
        expect(findings).to_have_count(len(report["findings"]))
        unfold(page)
        text = page.get_by_role("region", name="Bericht").inner_text()
        assert [part for one in said for part in phrases(one) if part in text] == []
        assert not re.search(r"\d\.\d", text)
        expect(page.get_by_text("Auch Montagen haben es")).to_have_count(text.count("Streulicht: "))


def test_failures_are_explained_in_german(
    browser: Browser, service: Service, ball: Path, ready: tuple[str, str], tmp_path: Path
) -> None:
    broken = tmp_path / "broken.zip"
    with zipfile.ZipFile(ball) as source, zipfile.ZipFile(broken, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(name, content if name.endswith(".json") else content[: len(content) // 2])
    capture = service.client.upload(broken)
    until(lambda: service.client.job(capture["job"])["state"] == "failed")
    with opened(browser, locale="de-DE") as page:
        for path in (f"captures/{capture['id']}", f"jobs/{capture['job']}", "jobs"):
            page.goto(f"{service.url}/#/{path}")
            expect(page.get_by_role("main")).to_contain_text("ist abgeschnitten oder beschädigt: neu von der")
            assert "cut off" not in page.evaluate(TEXTS)
        page.goto(f"{service.url}/#/mattes/{ready[1]}")
        page.get_by_label("Bild oder Clip").set_input_files(
            {"name": "beach.png", "mimeType": "image/png", "buffer": b"none"}
        )
        alert = page.get_by_role("alert")
        expect(alert).to_contain_text("kein Bild in")
        assert "the image" not in alert.inner_text().lower()


@pytest.mark.parametrize(
    ("english", "german"),
    [
        (
            "the camera moved by 0.53 pixels (a frame is located to 0.010): recovery shifts the frames back",
            "die Kamera hat sich um 0,53 Pixel bewegt (ein Bild ist auf 0,010 genau bestimmt): Die Berechnung schiebt "
            "die Bilder zurück",
        ),
        (
            "film again: start the recording before the program; something new; keep hands and other light away, and "
            "camera, glass and monitor at rest",
            "neu filmen: die Aufnahme vor dem Programm starten; something new; Hände und anderes Licht fernhalten, "
            "und Kamera, Glas und Monitor in Ruhe lassen",
        ),
        (
            "3 of 140 patterns have no frame that can be used: 1, 4-6 (the recording begins after it); 9 (no two "
            "frames of it are alike: it was too short, or something moved)",
            "3 von 140 Mustern haben kein brauchbares Bild: 1, 4-6 (die Aufnahme beginnt erst danach); 9 (keine zwei "
            "Bilder davon gleichen sich: Es war zu kurz, oder etwas hat sich bewegt)",
        ),
        ("expose half a stop more", "eine halbe Blende reichlicher belichten"),
        ("name: must have at most 200 characters", "name: darf höchstens 200 Zeichen haben"),
        ("nobody has translated this: 1.5 of it", "nobody has translated this: 1.5 of it"),
        pytest.param("a: b; " * 300, "a: b; " * 300, id="many parts"),
    ],
)
def test_sentences_are_put_together_of_what_is_known(
    browser: Browser, service: Service, english: str, german: str
) -> None:
    for locale, expected in (("de-DE", german), ("en-GB", english)):
        with opened(browser, locale=locale) as page:
            page.goto(f"{service.url}/#/captures")
            expect(page.locator("html")).to_have_attribute("lang", locale[:2])
            assert page.evaluate(SAY, english) == expected


def test_page_of_a_link_speaks_the_language_of_its_reader(
    browser: Browser, service: Service, ready: tuple[str, str]
) -> None:
    path = service.http.post(f"/v1/mattes/{ready[1]}/links", json={}).json()["path"]
    for locale, text in (
        ("de-AT", "Das Bild ziehen"),
        ("fr-FR", "Drag the picture"),
        ("en-US", "Drag the picture"),
    ):
        with opened(browser, locale=locale) as page:
            page.goto(service.url + path)
            expect(page.get_by_text(text)).to_be_visible()
            expect(page.locator("html")).to_have_attribute("lang", locale[:2].replace("fr", "en"))


def test_language_is_chosen_at_the_top_and_kept(desk: Page, service: Service) -> None:
    desk.add_init_script(BY_HAND)
    desk.goto(f"{service.url}/#/captures")
    expect(desk.get_by_label(ZIP)).to_be_attached()
    header = desk.get_by_role("banner")
    expect(header.get_by_role("button", name="English")).to_have_count(0)
    header.get_by_role("button", name="Deutsch").click()
    expect(desk.get_by_role("heading", name="Aufnahmen")).to_be_visible()
    desk.reload()
    expect(desk.get_by_role("heading", name="Aufnahmen")).to_be_visible()
    header.get_by_role("button", name="English").click()
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
