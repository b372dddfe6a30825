"""Captures in the app: films and archives that are dropped, and the frames of a capture."""

import base64
import io
import json
import os
import re
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.pages import BY_HAND, MINUTE, ZIP
from tests.end_to_end.conftest import BANDS, Service
from tests.parts.captures import nested_program
from tests.workflows.ingest.video.camera import Camera, film, lights
from workflows.images import integer_formats
from workflows.programs.program import Program
from workflows.simulation import glass_ball

pytestmark = pytest.mark.slow

RATE = 4


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of a program without a border."""
    program = nested_program(bands=BANDS[:1], levels=2)
    path = tmp_path_factory.mktemp("film") / "IMG 0001.MOV"
    path.write_bytes(film(lights(glass_ball.glass_ball(96, 72, rays=4), program), Camera(hold=1 / RATE)).data)
    path.with_suffix(".json").write_text(
        json.dumps(
            {
                "format": "envmatte-capture/1",
                "program": program.model_dump(mode="json"),
                "video": {"file": "film.mp4", "patterns_per_second": RATE},
            }
        )
    )
    return path


def test_film_with_its_manifest_becomes_a_capture(desk: Page, service: Service, clip: Path) -> None:
    desk.add_init_script(BY_HAND)
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(clip)
    field = desk.get_by_label("Or the capture.json that came with the program")
    for wrong, reason in ((b"<holiday>", "it is not JSON"), (b"null", "it describes no video")):
        field.set_input_files({"name": "holiday.json", "mimeType": "application/json", "buffer": wrong})
        expect(desk.get_by_text(f"Not the right capture.json: {reason}.")).to_be_visible()
    field.set_input_files(clip.with_suffix(".json"))
    expect(desk.get_by_role("heading", name="IMG 0001")).to_be_visible(timeout=MINUTE)
    expect(desk.get_by_role("region", name="Report")).to_be_visible(timeout=2 * MINUTE)
    found = service.client.capture(desk.url.rpartition("/")[2])
    assert (found["state"], found["width"], found["height"]) == ("ready", 96, 72)


def test_archive_of_a_matte_comes_back_as_a_matte(
    desk: Page, service: Service, ready: tuple[str, str], tmp_path: Path
) -> None:
    archive = tmp_path / "whisky glass.zip"
    service.client.export(ready[1], archive)
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(archive)
    expect(desk.get_by_role("heading", name="whisky glass")).to_be_visible(timeout=MINUTE)
    expect(desk.get_by_text("exact, 96 × 72 pixels")).to_be_visible()
    matte = re.sub(r".*mattes/(\w+).*", r"\1", desk.url)
    assert matte != ready[1]
    assert service.client.matte(matte).capture is None


def test_film_without_manifest_asks_for_its_program(desk: Page, service: Service, clip: Path) -> None:
    made = service.http.post(
        "/v1/programs", json={"preset": "sketch", "monitor": {"width": 800, "height": 450}, "border": True}
    ).json()
    showing = {
        "phase": "shown",
        "patterns_per_second": 3.5,
        "shown": 32,
        "border": {"width": 801, "height": 451},
    }
    assert service.http.put(f"/v1/programs/{made['id']}/showing", json=showing).status_code == 204
    desk.goto(f"{service.url}/#/captures")
    desk.get_by_label(ZIP).set_input_files(clip)
    expect(desk.get_by_text("Which program does this show?")).to_be_visible()
    choice = desk.get_by_label("Program", exact=True)
    choice.select_option(choice.locator("option", has_text="800 × 450").first.get_attribute("value"))
    expect(desk.get_by_label("Patterns a second")).to_have_value("3.5")
    desk.get_by_role("button", name="Upload", exact=True).click()
    expect(desk.get_by_role("heading", name="IMG 0001")).to_be_visible(timeout=MINUTE)
    found = service.client.capture(desk.url.rpartition("/")[2])["program"]
    assert Program.model_validate(found) == Program.model_validate(made["program"])


def test_stills_become_a_capture(desk: Page, service: Service, ball: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(ball) as archive:
        manifest = archive.extract("capture.json", tmp_path)
        frames = sorted(json.loads(Path(manifest).read_text())["frames"], key=lambda one: one["pattern"])
        stills = [tmp_path / f"DSC_{9 + n}.PNG" for n in range(len(frames))]
        for frame, still in zip(frames, stills, strict=True):
            still.write_bytes(archive.read(frame["file"]))
    desk.add_init_script(BY_HAND)
    for taken in (stills[:-1], stills):
        desk.goto(f"{service.url}/#/captures")
        desk.reload()
        desk.get_by_label(ZIP).set_input_files(taken)
        desk.get_by_label("Or the capture.json that came with the program").set_input_files(manifest)
        if taken != stills:
            expect(desk.get_by_role("alert")).to_contain_text(
                f"shows {len(stills)} pictures, and you chose {len(taken)} stills"
            )
    expect(desk.get_by_role("heading", name="a ball")).to_be_visible(timeout=MINUTE)
    expect(desk.get_by_role("region", name="Report")).to_be_visible(timeout=2 * MINUTE)
    found = service.client.capture(desk.url.rpartition("/")[2])
    assert (found["state"], found["frames"]) == ("ready", len(stills))
    first = service.http.get(f"/v1/captures/{found['id']}/frames/1.png").content
    assert np.array_equal(Image.open(io.BytesIO(first)), Image.open(stills[1]))


@pytest.mark.parametrize(
    ("names", "taken", "note"),
    [
        (
            ["DSC_0001.JPG", "DSC_0002.JPG", "DSC_9999.JPG"],
            "9999 0001 0002",
            "DSC_0001.JPG is taken as the one after",
        ),
        (["IMG_9.CR3", "IMG_9.JPG", "IMG_10.CR3", "IMG_10.JPG"], "9 10", "those in .CR3 are taken"),
    ],
)
def test_what_is_done_to_stills_is_said_before(
    desk: Page, service: Service, tmp_path: Path, names: list[str], taken: str, note: str
) -> None:
    desk.goto(f"{service.url}/#/captures")
    for name in names:
        (tmp_path / name).write_bytes(b"still")
        os.utime(tmp_path / name, (1e9, 1e9))
    desk.get_by_label(ZIP).set_input_files([tmp_path / name for name in names])
    expect(desk.get_by_text(note)).to_be_visible()
    desk.get_by_role("button", name="Continue", exact=True).click()
    expect(desk.get_by_label("Or the capture.json that came with the program")).to_be_attached()
    stills = desk.evaluate(
        """async (names) => {
            const { together } = await import("/web/app/upload/archive.js");
            const files = names.map((name) => new File([], name, { lastModified: 1 }));
            return together(files).stills.map(({ name }) => name);
        }""",
        names,
    )
    assert " ".join(re.sub(r"\D*(\d+).*", r"\1", name) for name in stills) == taken


def test_numbers_out_of_the_order_of_time_stay(desk: Page, service: Service) -> None:
    """Stills that were chosen of two series, and names without a wide gap."""
    desk.goto(f"{service.url}/#/captures")
    expect(desk.get_by_role("heading", name="Captures")).to_be_visible()
    in_order = """async (stills) => {
        const { together } = await import("/web/app/upload/archive.js");
        const files = stills.map(([name, lastModified]) => new File([], name, { lastModified }));
        return together(files).stills.map(({ name }) => name);
    }"""
    for stills in (
        [["A1.PNG", 5], ["A9999.PNG", 6]],
        [["A1.PNG", 9], ["A90.PNG", 7]],
        [["1.NEF", 5], ["2.JPG", 5]],
    ):
        assert desk.evaluate(in_order, stills) == [name for name, _ in stills]


def test_film_and_manifest_are_zipped(desk: Page, service: Service) -> None:
    desk.goto(f"{service.url}/#/captures")
    text = desk.evaluate(
        """async () => {
            const { filmArchive, filmManifestOf } = await import("/web/app/upload/archive.js");
            const showing = { border: { width: 641, height: 361 } };
            const program = { program: { parts: [] }, display: { width: 640, height: 360 }, showing };
            const manifest = filmManifestOf(program, 3.5);
            const film = new File([new Uint8Array(9e6).map((_, i) => i % 251)], "Größe.WebM", { type: "video/webm" });
            const archive = await filmArchive(film, manifest);
            return new Promise((resolve) => {
                const reader = new FileReader();
                reader.onload = () => resolve(reader.result);
                reader.readAsDataURL(archive);
            });
        }"""
    )
    with zipfile.ZipFile(io.BytesIO(base64.b64decode(text.partition(",")[2]))) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["capture.json", "film.webm"]
        assert len(archive.read("film.webm")) == 9_000_000
        assert json.loads(archive.read("capture.json")) == {
            "format": "envmatte-capture/1",
            "name": "Größe",
            "program": {"parts": []},
            "video": {
                "file": "film.webm",
                "patterns_per_second": 3.5,
                "border": {"width": 641, "height": 361},
            },
        }


def test_film_of_gigabytes_is_zipped(desk: Page, service: Service, tmp_path: Path) -> None:
    """The page makes the headers only; a hole in the file stands for the film."""
    size, manifest = 5 << 30, b"{}"
    files = [
        {"name": "film.mp4", "size": size, "crc": 0},
        {"name": "capture.json", "size": len(manifest), "crc": zlib.crc32(manifest)},
    ]
    desk.goto(f"{service.url}/#/captures")
    parts = desk.evaluate(
        """async (files) => {
            const { framed } = await import("/web/app/upload/zip.js");
            const { heads, end } = framed(files);
            return Promise.all([...heads, end].map(async (part) => [...new Uint8Array(await part.arrayBuffer())]));
        }""",
        files,
    )
    with (tmp_path / "film.zip").open("w+b") as file:
        file.write(bytes(parts[0]))
        file.seek(size, 1)
        file.write(bytes(parts[1]) + manifest + bytes(parts[2]))
        with zipfile.ZipFile(file) as archive:
            film, entry = archive.infolist()
            assert (film.filename, film.file_size, film.compress_size) == ("film.mp4", size, size)
            assert entry.header_offset == len(parts[0]) + size
            assert archive.read("capture.json") == manifest
            with archive.open("film.mp4") as entry:
                assert entry.read(4) == bytes(4)


def test_number_and_size_of_frames_are_sent_before_the_archive(
    desk: Page, service: Service, ball: Path, tmp_path: Path
) -> None:
    packed, jpeg, film = (tmp_path / name for name in ("packed.zip", "jpeg.zip", "film.zip"))
    manifest = {"frames": [{"file": "ä.jpg", "pattern": 0}] * 3}
    parts = [
        {"kind": "constant", "levels": [0, 1]},
        {"kind": "bernoulli", "columns": 8, "rows": 6, "count": 16, "seed": 1},
    ]
    filmed = {"program": {"parts": parts}, "video": {"file": "film.mp4"}}
    with zipfile.ZipFile(ball) as source, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as made:
        for name in source.namelist():
            made.writestr(name, source.read(name))
    for path, about in ((jpeg, manifest), (film, filmed)):
        with zipfile.ZipFile(path, "w") as made:
            made.writestr("capture.json", json.dumps(about))
            made.writestr("ä.jpg", integer_formats.encode_jpeg(np.zeros((33, 70, 3), np.uint8), 90))
    (tmp_path / "none.zip").write_bytes(b"PK and nothing more")
    of_ball = {"frames": len(json.loads(zipfile.ZipFile(ball).read("capture.json"))["frames"])}
    of_ball |= {"width": 96, "height": 72}
    desk.goto(f"{service.url}/#/captures")
    for path, expected in (
        (ball, of_ball),
        (packed, of_ball),
        (jpeg, {"frames": 3, "width": 70, "height": 33}),
        (film, {"frames": 18}),
        (tmp_path / "none.zip", {}),
    ):
        found = desk.evaluate(
            """async (data) => {
                const { readArchiveInfo } = await import("/web/app/upload/archive_info.js");
                return readArchiveInfo(new Blob([Uint8Array.from(atob(data), (one) => one.charCodeAt(0))]));
            }""",
            base64.b64encode(path.read_bytes()).decode(),
        )
        assert found == expected, path
    with desk.expect_request(
        lambda request: request.method == "POST" and request.url.endswith("/uploads")
    ) as sent:
        desk.get_by_label(ZIP).set_input_files(packed)
    metadata = dict(pair.split(" ") for pair in (sent.value.header_value("upload-metadata") or "").split(","))
    values = {name: base64.b64decode(value).decode() for name, value in metadata.items()}
    assert values.pop("filename") == "packed.zip"
    assert {name: int(value) for name, value in values.items()} == of_ball


def test_frames_are_browsed_by_keys(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    last = service.client.capture(ready[0])["frames"] - 1
    slider = desk.get_by_role("slider", name="Frame")
    slider.focus()
    for key, frame in (
        ("Home", 0),  # as the report and names of files count
        ("ArrowRight", 1),
        ("PageUp", None),
        ("End", last),
        ("ArrowLeft", last - 1),
    ):
        slider.press(key)
        if frame is not None:
            expect(desk.get_by_text(f"{frame} (0 to {last})")).to_be_visible()
            expect(desk.get_by_alt_text(f"Frame {frame}", exact=True)).to_be_visible()


def test_older_mattes_of_a_capture_are_folded(desk: Page, service: Service, ready: tuple[str, str]) -> None:
    one = service.http.get(f"/v1/mattes/{ready[1]}").json()
    some = {"mattes": [one | {"name": f"matte {n}"} for n in range(5)]}
    desk.route(re.compile(r"/v1/mattes\?capture="), lambda route: route.fulfill(json=some))
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    shown = desk.get_by_role("region", name="Mattes").get_by_role("link")
    expect(shown).to_have_count(2)
    desk.get_by_text("3 older").click()
    expect(shown).to_have_count(5)


def test_pictures_of_a_capture_are_fetched_again_after_an_outage(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    desk.clock.install()
    desk.route("**/*.png", lambda route: route.abort("connectionreset"))
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    pictures = desk.locator("main .picture > img")
    expect(pictures).to_have_count(2)
    for _ in range(2):  # each is asked for twice
        desk.clock.run_for(500)
        desk.wait_for_timeout(100)
    expect(desk.get_by_role("alert")).to_have_count(2)
    desk.unroute("**/*.png")
    desk.clock.run_for(5000)
    for picture in pictures.all():
        expect(picture).to_be_visible()
    expect(desk.get_by_role("alert")).to_have_count(0)


def test_question_ends_with_the_view_that_asks_it(
    desk: Page, service: Service, ready: tuple[str, str]
) -> None:
    desk.goto(f"{service.url}/#/captures")
    desk.goto(f"{service.url}/#/captures/{ready[0]}")
    desk.get_by_role("button", name="Delete", exact=True).click()
    question = desk.get_by_role("dialog", name="Delete this capture?")
    expect(question).to_be_visible()
    desk.go_back()
    expect(desk).to_have_title("Captures · envmatte")
    expect(question).to_be_hidden()
    assert service.client.capture(ready[0])["state"] == "ready"
