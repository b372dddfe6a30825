"""Composites over HTTP."""

import io
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx2
import imagecodecs
import numpy as np
import psutil
import pytest
from PIL import Image

from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import HEIGHT, TILES, WIDTH, Service, png
from tests.end_to_end.problems import check_problem
from tests.services.cluster.clusters import decoders
from workflows.images import float_formats, integer_formats
from workflows.images.tone_curves import from_light
from workflows.programs.presets import preset
from workflows.simulation.scene import Scene, write_capture

BACKDROP = np.random.default_rng(0).random((30, 40, 3), np.float32).repeat(4, axis=0).repeat(4, axis=1)
SENT = png(BACKDROP, "srgb", np.uint8)


def post_composite(
    service: Service, matte: str, body: bytes = SENT, accept: str = "image/png", **query
) -> httpx2.Response:
    return service.http.post(
        f"/v1/mattes/{matte}/composite", params=query, content=body, headers={"Accept": accept}
    )


def decoded(answer: httpx2.Response) -> np.ndarray:
    assert answer.status_code == 200, answer.text
    return integer_formats.decode(answer.content, memory=1 << 24)


def test_png_jpeg_and_exr_show_the_same_picture(service: Service, matte: str) -> None:
    exr = post_composite(service, matte, accept="image/x-exr")
    assert exr.headers["content-type"] == "image/x-exr"
    light = float_formats.decode(exr.content, memory=1 << 24)
    shown = decoded(post_composite(service, matte))
    expected = integer_formats.to_integers(from_light(np.clip(light, 0, 1), "srgb"), np.dtype(np.uint8))
    assert np.abs(shown.astype(int) - expected).max() <= 1
    assert (shown == expected).mean() > 0.999
    jpeg = post_composite(service, matte, accept="text/html, image/jpeg;q=0.9, image/png;q=0.1", quality=100)
    assert jpeg.headers["content-type"] == "image/jpeg"
    assert np.abs(decoded(jpeg).astype(int) - shown).max() <= 6
    assert (
        len(post_composite(service, matte, accept="image/jpeg", quality=20).content) < len(jpeg.content) / 3
    )


def test_exr_backdrop_gives_exr_composite(service: Service, matte: str) -> None:
    def seen(gain: float) -> np.ndarray:
        sent = float_formats.encode_exr("RGB", BACKDROP * np.float32(gain))
        return float_formats.decode(
            post_composite(service, matte, sent, "image/x-exr").content, memory=1 << 24
        )

    dark, once, four = seen(0), seen(1), seen(4)
    assert four.max() > 2
    np.testing.assert_allclose(four - dark, 4 * (once - dark), atol=1e-4)
    deep = decoded(post_composite(service, matte, float_formats.encode_exr("RGB", BACKDROP)))
    assert deep.dtype == np.uint16


def test_crop_and_preview_are_of_the_whole(service: Service, matte: str) -> None:
    whole = decoded(post_composite(service, matte))
    crop = decoded(post_composite(service, matte, x=10, y=20, width=31, height=17))
    np.testing.assert_array_equal(crop, whole[20:37, 10:41])
    np.testing.assert_array_equal(decoded(post_composite(service, matte, x=60, y=45)), whole[45:, 60:])
    assert decoded(post_composite(service, matte, size=48)).shape == (36, 48, 3)
    assert decoded(post_composite(service, matte, size=500)).shape == whole.shape


@pytest.mark.parametrize("kind", ["image/png", "image/jpeg", "image/x-exr"])
def test_twice_the_size_shows_the_same(service: Service, matte: str, kind: str) -> None:
    def read(answer: httpx2.Response) -> np.ndarray:
        if kind == "image/x-exr":
            return float_formats.decode(answer.content, memory=1 << 24)[..., :3]
        return decoded(answer)[..., :3].astype(float) / 255

    whole = read(post_composite(service, matte, accept=kind))
    large = read(post_composite(service, matte, accept=kind, enlarge=2))
    assert large.shape == (2 * whole.shape[0], 2 * whole.shape[1], 3)
    same = large.reshape(*whole.shape[:1], 2, whole.shape[1], 2, 3).mean(axis=(1, 3))
    assert np.abs(same - whole).mean() < 0.03
    check_problem(post_composite(service, matte, enlarge=2, size=30), 422, "bad-request")


def test_intervals_hold_the_truth(service: Service, scene: Scene, tmp_path: Path) -> None:
    write_capture(scene, preset("sketch", *scene.monitor), tmp_path / "ball.zip")
    capture = service.client.upload(tmp_path / "ball.zip")
    matte = str(service.client.wait(service.client.recover(capture["id"])["id"])["matte"])

    def read(**query: bool) -> np.ndarray:
        answer = post_composite(service, matte, accept="image/x-exr", transfer="linear", **query)
        assert answer.status_code == 200, answer.text
        return float_formats.decode(answer.content, memory=1 << 24)[..., :3]

    sent = integer_formats.to_unit(integer_formats.decode(SENT, memory=1 << 24))
    error = np.abs(read() - scene.truth(sent))
    half = read(interval=True)
    seen = scene.object_mask
    assert 0.8 < (error <= half)[seen].mean() < 0.99
    assert np.corrcoef(error[seen].ravel(), half[seen].ravel())[0, 1] > 0.2
    shown = integer_formats.to_unit(decoded(post_composite(service, matte, transfer="linear", interval=True)))
    assert np.abs(shown - half).max() < 1 / 255
    for query in ({"depth": 2, "distance": 1, "camera": 1}, {"around": "backdrop"}, {"fit": "frame"}):
        check_problem(post_composite(service, matte, interval=True, **query), 422, "bad-request")


def test_unknown_interval_is_refused(service: Service, matte: str) -> None:
    problem = check_problem(post_composite(service, matte, interval=True), 409, "conflict")
    assert "fixed grids" in problem["detail"]


@pytest.mark.parametrize(
    ("query", "field"),
    [({"x": 64}, "x"), ({"y": 40, "height": 9}, "y"), ({"width": 65}, "x"), ({"x": 60, "width": 10}, "x")],
)
def test_crop_outside_is_refused(service: Service, matte: str, query: dict[str, int], field: str) -> None:
    problem = check_problem(post_composite(service, matte, **query), 422, "bad-option")
    assert problem["field"] == field
    assert "64 x 48" in problem["detail"]


@pytest.mark.parametrize(
    "query", [{"size": 0}, {"quality": 101}, {"scale": 0}, {"crop": 1}, {"x": -1}, {"enlarge": 3}]
)
def test_invalid_query_is_refused(service: Service, matte: str, query: dict[str, int]) -> None:
    assert check_problem(post_composite(service, matte, **query), 422, "bad-request")["field"] in query


def test_moved_backdrop_is_one_drawn_elsewhere(service: Service, matte: str) -> None:
    half = np.zeros_like(BACKDROP)
    half[:, 80:] = BACKDROP[:, :80]
    moved = decoded(post_composite(service, matte, right=0.5)).astype(int)
    expected = decoded(post_composite(service, matte, png(half, "srgb", np.uint8))).astype(int)
    assert np.abs(moved - expected).mean() < 1.5
    assert np.abs(moved - decoded(post_composite(service, matte))).mean() > 10


def test_backdrop_at_another_depth_moves_the_glass(service: Service, matte: str) -> None:
    still = decoded(post_composite(service, matte)).astype(int)
    depths = {"distance": 3, "camera": 5}
    same = decoded(post_composite(service, matte, depth=3, **depths)).astype(int)
    assert np.abs(same - still).mean() < 0.5
    farther = decoded(post_composite(service, matte, depth=4, **depths)).astype(int)
    assert np.abs(farther - still).mean() > 5
    for query in ({"depth": 3}, {"distance": 3}, {"depth": 3, "distance": 3, "other": matte}):
        found = check_problem(post_composite(service, matte, **query), 422, "bad-request")
        assert "depth, distance and camera" in found["detail"]
    missing = {"depth": 3, "distance": 3, "other": "no-such-id", "other_distance": 4}
    check_problem(post_composite(service, matte, **missing), 404, "not-found")


def test_known_etag_is_not_computed_again(service: Service, matte: str) -> None:
    url = f"/v1/mattes/{matte}/composite"
    first = service.http.post(url, content=SENT)
    tag = first.headers["etag"]
    again = service.http.post(url, content=SENT)
    assert (again.headers["etag"], again.content) == (tag, first.content)
    known = service.http.post(url, content=SENT, headers={"If-None-Match": f'"other", {tag}'})
    check_problem(known, 412, "not-needed")
    assert known.headers["etag"] == tag
    others = [
        post_composite(service, matte, size=40),
        post_composite(service, matte, png(BACKDROP[::-1], "srgb", np.uint8)),
        post_composite(service, matte, accept="image/jpeg"),
    ]
    assert len({tag, *(other.headers["etag"] for other in others)}) == 4


def test_command_line_gives_the_same_picture(service: Service, matte: str, tmp_path) -> None:
    (tmp_path / "backdrop.png").write_bytes(SENT)
    for name, kind in (("a.png", "image/png"), ("a.jpg", "image/jpeg"), ("a.exr", "image/x-exr")):
        out = tmp_path / name
        command = ["composite", matte, str(tmp_path / "backdrop.png"), "-o", str(out)]
        envmatte(service, *command)
        assert out.read_bytes() == post_composite(service, matte, accept=kind).content


def test_simultaneous_requests_get_the_same_picture(service: Service, matte: str) -> None:
    expected = post_composite(service, matte, accept="image/jpeg").content
    with ThreadPoolExecutor(16) as threads:
        answers = list(
            threads.map(lambda _: post_composite(service, matte, accept="image/jpeg").content, range(64))
        )
    assert set(answers) == {expected}


@pytest.mark.slow
def test_unfinished_matte_is_composited_as_far_as_recovered(service: Service, capture: str) -> None:
    job = service.client.recover(capture, tile=16)
    shares: list[float] = []
    pictures: list[np.ndarray] = []

    def look(found: dict) -> None:
        answer = post_composite(service, job["matte"])
        if answer.status_code == 409:
            assert "nothing of it is there yet" in answer.json()["detail"]
            return
        shares.append(float(answer.headers["envmatte-recovered"]))
        pictures.append(
            decoded(answer)
            if shares[-1] == 1
            else integer_formats.decode(answer.content, memory=1 << 24, alpha=True)
        )

    service.client.wait(job["id"], progress=look, poll=0.05)
    final = decoded(post_composite(service, job["matte"]))
    assert shares == sorted(shares)
    assert any(0 < share < 1 for share in shares), shares
    for share, picture in zip(shares, pictures, strict=True):
        if share < 1:
            recovered = picture[..., 3] > 0
            tiles = recovered.reshape(HEIGHT // 16, 16, WIDTH // 16, 16).any(axis=(1, 3))
            assert tiles.sum() == round(share * TILES)
            np.testing.assert_array_equal(picture[recovered][:, :3], final[recovered])
    assert post_composite(service, job["matte"]).headers["envmatte-recovered"] == "1.0000"
    assert service.http.delete(f"/v1/mattes/{job['matte']}").status_code == 204


@pytest.mark.slow
def test_matte_deleted_while_it_is_composited(service: Service, capture: str) -> None:
    matte = service.client.wait(service.client.recover(capture)["id"])["matte"]
    expected = post_composite(service, matte).content
    answers: list[httpx2.Response] = []

    def request() -> None:
        with httpx2.Client(base_url=service.url, timeout=60) as http:
            while not answers or answers[-1].status_code == 200:
                answers.append(
                    http.post(f"/v1/mattes/{matte}/composite", content=SENT, headers={"Accept": "image/png"})
                )

    requester = threading.Thread(target=request)
    requester.start()
    while len(answers) < 3:
        pass
    assert service.http.delete(f"/v1/mattes/{matte}").status_code == 204
    requester.join()
    assert all(answer.content == expected for answer in answers[:-1])
    check_problem(answers[-1], 404, "not-found")


def saved(picture: Image.Image, kind: str, **options: object) -> bytes:
    target = io.BytesIO()
    picture.save(target, kind, **options)
    return target.getvalue()


@pytest.mark.parametrize(
    "body",
    [
        saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)).convert("CMYK"), "JPEG"),
        saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)).convert("P"), "PNG"),
        saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)).convert("RGBA"), "PNG"),
        saved(
            Image.fromarray((255 * BACKDROP).astype(np.uint8)),
            "JPEG",
            icc_profile=imagecodecs.cms_profile("adobergb"),
        ),
        *(
            saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)), kind)
            for kind in ("WEBP", "AVIF", "GIF")
        ),
        saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)[:1, :1]), "PNG"),
        saved(Image.fromarray((255 * BACKDROP).astype(np.uint8)[:, :1]), "TIFF"),
    ],
    ids=["cmyk", "palette", "alpha", "profile", "WebP", "AVIF", "GIF", "one pixel", "one column"],
)
def test_every_kind_of_picture_is_a_backdrop(service: Service, matte: str, body: bytes) -> None:
    assert decoded(post_composite(service, matte, body)).shape == (HEIGHT, WIDTH, 3)


def test_8_bit_backdrop_with_alpha_gives_8_bits(service: Service, matte: str) -> None:
    codes = (255 * BACKDROP).astype(np.uint8)
    glassy = np.concatenate([codes, np.full((*codes.shape[:2], 1), 100, np.uint8)], axis=2)
    assert decoded(post_composite(service, matte, integer_formats.encode_png(glassy))).dtype == np.uint8


def test_decompression_bomb_is_refused(service: Service, matte: str) -> None:
    bomb = saved(Image.new("1", (20_000, 20_000)), "PNG")
    assert len(bomb) < 1 << 20
    problem = check_problem(post_composite(service, matte, bomb), 422, "bad-image")
    assert "takes more" in problem["detail"]
    assert "make it smaller" in problem["detail"]
    cut = check_problem(post_composite(service, matte, SENT[: len(SENT) // 2]), 422, "bad-image")
    assert "cut off or damaged" in cut["detail"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "requests", [300, pytest.param(10_000, marks=[pytest.mark.exhaustive, pytest.mark.timeout(3600)])]
)
def test_requests_leak_nothing(service: Service, matte: str, requests: int) -> None:
    """Neither in the API's process nor in its decoders."""
    askers = 4

    def ask(count: int) -> None:
        with ThreadPoolExecutor(askers) as threads:
            list(
                threads.map(
                    lambda _: post_composite(service, matte, accept="image/jpeg", size=24), range(count)
                )
            )

    def held() -> dict[int, np.ndarray]:
        """Memory in bytes, open files and threads of each process."""
        every = [psutil.Process(service.process.pid), *decoders(service.process)]
        return {
            one.pid: np.array([one.memory_full_info().uss, one.num_fds(), one.num_threads()]) for one in every
        }

    ask(requests // 3)  # until every thread has filled its caches
    looks = [held()]
    for _ in range(6):
        ask(requests // 6)
        looks.append(held())
    assert set(looks[0]) <= set(looks[-1]), "a decoder is gone"
    assert 1 < len(looks[-1]) <= 1 + askers
    # Other decoders may have been started.
    sums = np.array([sum(look[pid] for pid in looks[0]) for look in looks])
    print(f"bytes, open files and threads, every {requests // 6} requests: {sums.tolist()}")
    # Under load blocks of 19 MB come, or connections to the database, and stay: what leaks grows from look to look.
    memory, files, threads = 6 * np.median(np.diff(sums, axis=0), axis=0)
    assert memory < 24 << 20
    assert files < 5
    assert threads < 5
