"""The web app in a real browser: from a ZIP to a composite, and compositing."""

import base64
import io
import re
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.browser.pages import BY_HAND, MINUTE, SIZE, opened, unfold
from tests.end_to_end.conftest import Service, serving
from tests.parts.waiting import until
from workflows.images import integer_formats


@pytest.fixture
def tab(desk: Page) -> Page:
    return desk


def pixels(data: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def shown(page: Page, image: str) -> NDArray[np.uint8]:
    """A picture as it is shown, (rows, columns, 3)."""
    url = page.evaluate(
        """(selector) => {
            const image = document.querySelector(selector);
            const [width, height] = [image.naturalWidth, image.naturalHeight];
            const canvas = Object.assign(document.createElement("canvas"), { width, height });
            canvas.getContext("2d").drawImage(image, 0, 0);
            return canvas.toDataURL("image/png");
        }""",
        image,
    )
    return pixels(base64.b64decode(url.partition(",")[2]))


def drop(page: Page, data: bytes, name: str) -> None:
    """Drop a file on the composite."""
    files = page.evaluate_handle(
        """([text, name]) => {
            const files = new DataTransfer();
            const data = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
            files.items.add(new File([data], name, { type: "image/png" }));
            return files;
        }""",
        [base64.b64encode(data).decode(), name],
    )
    page.get_by_role("group", name="Composite.").dispatch_event("drop", {"dataTransfer": files})


def picture(seed: int, width: int, height: int) -> bytes:
    """A backdrop."""
    blocks = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    return integer_formats.encode_png(np.kron(blocks, np.ones((height // 6, width // 8, 1), np.uint8)))


def test_upload_report_recovery_and_composite(tab: Page, service: Service, ball: Path) -> None:
    tab.add_init_script(BY_HAND)
    tab.goto(f"{service.url}/#/captures")
    tab.get_by_label("Choose a film, stills or a capture archive").set_input_files(ball)
    expect(tab).to_have_url(re.compile(r"#/captures/\w+"), timeout=MINUTE)
    expect(tab.get_by_role("heading", name="a ball")).to_be_visible()
    # Kernels compile first.
    expect(tab.get_by_role("region", name="Report")).to_be_visible(timeout=3 * MINUTE)
    capture = service.client.capture(tab.url.rpartition("/")[2])
    report = service.http.get(capture["report"]).json()
    expect(tab.get_by_role("heading", name=re.compile("expect( at best)? .* clear glass"))).to_be_visible()
    assert set(capture["recovery_seconds"]) == {"fine", "fast"}
    findings = tab.locator(".findings li")  # what is fine is folded
    expect(findings).to_have_count(len(report["findings"]))
    for number, finding in enumerate(report["findings"]):
        expect(findings.nth(number)).to_contain_text(finding["level"])
        expect(findings.nth(number)).to_contain_text(finding["message"].replace("`", ""), ignore_case=True)
    expect(tab.get_by_alt_text("Some of the frames")).to_be_visible()
    tab.get_by_role("slider", name="Frame").fill("3")
    expect(tab.get_by_text(f"3 (0 to {capture['frames'] - 1})")).to_be_visible()
    expect(tab.get_by_alt_text("Frame 3", exact=True)).to_be_visible()

    draft = tab.get_by_role("radio", name="Draft")
    expect(draft.locator("..")).to_contain_text(re.compile(r"about .+ (s|min)"))
    draft.check()
    tab.get_by_role("button", name="Recover", exact=True).click()
    expect(tab).to_have_url(re.compile(r"#/jobs/\w+"))
    expect(tab.get_by_role("progressbar")).to_be_visible()
    expect(tab.get_by_alt_text("The composite of what is recovered so far")).to_be_visible(timeout=MINUTE)
    expect(tab.locator(".log li").first).to_contain_text("queued")
    tab.get_by_role("link", name="Open the matte").click(timeout=MINUTE)

    expect(tab).to_have_url(re.compile(r"#/mattes/\w+"))
    matte = tab.url.rpartition("/")[2]
    assert service.client.matte(matte)["options"]["quality"] == "fast"
    assert service.client.matte(matte)["options"]["most_lobes"] == 2  # of `fast`: no other option was sent
    exact = re.compile(rf"^beach\.png: exact, {SIZE[0]} × {SIZE[1]} pixels")
    beach = picture(0, 1600, 1200)
    drop(tab, beach, "beach.png")
    expect(tab.get_by_text(exact)).to_be_visible(timeout=MINUTE)
    answer = service.http.post(
        f"/v1/mattes/{matte}/composite?around=backdrop", content=beach, headers={"Accept": "image/png"}
    )
    error = np.mean((shown(tab, ".picture.stage img") - pixels(answer.content).astype(float)) ** 2)
    assert 10 * np.log10(255**2 / error) > 28


@pytest.mark.slow
def test_backdrop_moves_by_mouse_and_keys(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    status = tab.get_by_text("exact")
    expect(status).to_be_visible(timeout=MINUTE)
    unfold(tab)
    stage = tab.get_by_role("group", name="Composite.")
    before = shown(tab, ".picture.stage img")
    box = stage.bounding_box()
    assert box
    requests: list[str] = []
    tab.on("request", lambda request: requests.append(request.url) if "/composite?" in request.url else None)
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + box["height"] / 2, steps=5)
    tab.mouse.up()
    right = tab.locator("output[for=place-right]")
    expect(right).to_have_text("25 %")
    expect(status).to_be_visible()
    assert "right=0.25" in requests[-1]
    assert "size=" not in requests[-1]
    assert np.mean(np.abs(shown(tab, ".picture.stage img") - before.astype(float))) > 5
    tab.mouse.wheel(0, -500)
    expect(tab.locator("output[for=place-scale]")).to_have_text("165 %")
    stage.focus()
    stage.press("ArrowLeft")
    expect(right).to_have_text("23 %")
    stage.press("]")
    expect(tab.locator("output[for=place-angle]")).to_have_text("2°")
    tab.get_by_role("slider", name="Size").press("End")
    expect(tab.locator("output[for=place-scale]")).to_have_text("1000 %")
    tab.get_by_role("button", name="Reset").click()
    expect(right).to_have_text("0 %")
    expect(status).to_be_visible()
    np.testing.assert_array_equal(shown(tab, ".picture.stage img"), before)
    for kind, magic in (("PNG", b"\x89PNG"), ("EXR", b"v/1\x01")):
        with tab.expect_download() as download:
            tab.get_by_role("button", name=kind, exact=True).click()
        name = service.client.matte(ready[1])["name"]
        assert download.value.suggested_filename == f"{name.replace(' ', '_')}.{kind.lower()}"
        assert download.value.path().read_bytes().startswith(magic)


@pytest.mark.slow
def test_layers_and_lobes_of_a_pixel(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    unfold(tab)
    for name in ("Reflections", "Mask", "Confidence", "Transparency"):
        tab.get_by_role("radio", name=name, exact=True).check()
        expect(tab.get_by_alt_text(f"The layer “{name}”")).to_be_visible()
        assert shown(tab, ".layer img").shape == (SIZE[1], SIZE[0], 3)
    tab.get_by_role("button", name="Explain a pixel").click()
    stage = tab.get_by_role("group", name="Composite.")
    stage.press("ArrowRight")
    words = tab.get_by_text("Pixel (49, 36)")
    expect(words).to_contain_text(
        re.compile(r"\d+ % of the monitor’s light comes through, \d+ % of it from the \w+")
    )
    box, picture = words.bounding_box(), stage.bounding_box()
    assert box
    assert picture
    assert picture["y"] <= box["y"] < picture["y"] + picture["height"]  # where the reader looks
    assert [one["id"] for one in Axe().run(tab).response["violations"]] == []
    figures = tab.locator(".composite .facts > div")
    pixel = service.http.get(f"/v1/mattes/{ready[1]}/transport?x=49&y=36").json()
    expect(figures).to_have_count(2 + len(pixel["lobes"]))
    expect(figures.first).to_contain_text(f"{100 * pixel['rho'][0]:.0f} %, {100 * pixel['rho'][1]:.0f} %")
    place = f"{pixel['lobes'][0]['u'] * 1280:.0f}, {(1 - pixel['lobes'][0]['v']) * 960:.0f}"
    expect(figures.filter(has_text="Lobe 1")).to_contain_text(f"at {place}")
    lobes = tab.locator(".lobes ellipse")
    expect(lobes).to_have_count(len(pixel["lobes"]))

    def is_in_place() -> bool:
        """Whether the first lobe is drawn where it is on the backdrop; while it is drawn again it has no box."""
        box, mark = tab.locator("canvas.inset").bounding_box(), lobes.first.bounding_box()
        if box is None or mark is None:
            return False
        at = (mark["x"] + mark["width"] / 2 - box["x"]) / box["width"]
        return abs(at - pixel["lobes"][0]["u"]) < 0.02

    until(is_in_place)
    stage.hover(position={"x": 5, "y": 5})
    expect(tab.get_by_text("Pixel (0, 0)")).to_be_visible()
    tab.get_by_role("button", name="Explain a pixel").click()
    expect(lobes).to_have_count(0)
    stage.press("ArrowRight")  # moves the backdrop again
    expect(tab.locator("output[for=place-right]")).to_have_text("2 %")


@pytest.mark.slow
def test_layers_for_other_tools_are_downloaded(tab: Page, service: Service, ready: tuple[str, str]) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    unfold(tab)
    for name in ("all.exr", "stmap.exr", "lookups.exr", "blender.py", "nuke.nk", "nuke_stmap.nk"):
        with tab.expect_download() as download:
            tab.get_by_role("button", name=name).click()
        assert download.value.suggested_filename == name
        expected = service.http.get(f"/v1/mattes/{ready[1]}/layers/{name}").content
        assert download.value.path().read_bytes() == expected


@pytest.mark.slow
def test_matte_is_downloaded_and_deleted_items_are_gone(
    tab: Page, service: Service, ready: tuple[str, str], ball: Path
) -> None:
    tab.goto(f"{service.url}/#/mattes/{ready[1]}")
    with tab.expect_download() as download:
        tab.get_by_role("button", name="Download the matte").click()
    assert download.value.suggested_filename == "a_ball.zip"
    imported = service.client.import_matte(download.value.path())
    uploaded = service.client.upload(ball)
    service.client.wait(uploaded["job"])
    for kind, id in (("mattes", imported["id"]), ("captures", uploaded["id"])):
        tab.goto(f"{service.url}/#/{kind}/{id}")
        drop = tab.get_by_role("button", name="Delete", exact=True)
        drop.click()
        tab.get_by_role("button", name="Cancel").click()
        expect(drop).to_be_enabled()
        assert service.http.get(f"/v1/{kind}/{id}").status_code == 200
        drop.click()
        tab.get_by_role("button", name=f"Delete {kind[:-1]}").click()
        expect(tab).to_have_url(re.compile(f"#/{kind}$"))
        expect(tab.locator(f'a[href="#/{kind}/{ready[kind == "mattes"]}"]')).to_be_visible()
        expect(tab.locator(f'a[href="#/{kind}/{id}"]')).to_have_count(0)
        assert service.http.get(f"/v1/{kind}/{id}").status_code == 404


@pytest.mark.exhaustive
@pytest.mark.slow
def test_expiry_dates_are_shown(
    browser: Browser, tab: Page, service: Service, ready: tuple[str, str], ball: Path, tmp_path: Path
) -> None:
    service.client.export(ready[1], archive := tmp_path / "matte.zip")
    zone = "Asia/Kathmandu"  # where no server is
    kept = {"ENVMATTE_CAPTURE_SECONDS": "100000", "ENVMATTE_MATTE_SECONDS": "200000"}
    with (
        serving(tmp_path / "data", "--workers", "1", **kept) as forgetful,
        opened(browser, timezone_id=zone) as page,
    ):
        capture = forgetful.client.upload(ball)["id"]
        matte = forgetful.client.import_matte(archive)["id"]
        for kind, id in (("captures", capture), ("mattes", matte)):
            expires = forgetful.http.get(f"/v1/{kind}/{id}").json()["expires_at"]
            local = datetime.fromisoformat(expires).astimezone(ZoneInfo(zone))
            page.goto(f"{forgetful.url}/#/{kind}/{id}")
            # Of a matte, it is in its details, which are closed.
            kept_until = page.locator("dt", has_text="Kept until").locator("+ dd")
            expect(kept_until).to_have_text(re.compile(rf"^{local.day} .* {local.year}, {local:%H:%M}$"))
    for kind, id in zip(("captures", "mattes"), ready, strict=True):
        tab.goto(f"{service.url}/#/{kind}/{id}")
        expect(tab.locator("dt", has_text="Monitor")).to_have_count(1)
        expect(tab.locator("dt", has_text="Kept until")).to_have_count(0)
