"""Layers and single pixels of a matte over HTTP."""

import io
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from click.testing import CliRunner
from PIL import Image

from services.cli.main import main
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service
from workflows.images import float_formats, integer_formats

PROBLEM = "application/problem+json"
WHITE = float_formats.encode_exr("RGB", np.ones((3, 4, 3), np.float32))


def empty_pixels(service: Service, matte: str) -> int:
    """How many pixels let light through and show none of a white backdrop, which makes them black before any."""
    exr = {"Accept": "image/x-exr"}
    answer = service.http.post(f"/v1/mattes/{matte}/composite", content=WHITE, headers=exr)
    seen = float_formats.decode(answer.content, memory=1 << 26)[..., :3]
    layers = service.client.matte(matte).layers
    S, rho = layers["S"], layers["rho"]
    assert np.mean(rho > 0.05) > 0.5
    return int(np.count_nonzero((rho > 0.05) & (seen - S < 0.5 * rho)))


def test_no_pixel_that_lets_light_through_is_empty(service: Service, matte: str) -> None:
    assert empty_pixels(service, matte) == 0


@pytest.mark.parametrize("name", ["S", "rho", "alpha", "confidence"])
def test_layer_as_png_and_as_exr(service: Service, matte: str, name: str) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/layers/{name}.exr")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/x-exr")
    exact = float_formats.decode(answer.content, memory=1 << 24)
    assert exact.shape == (HEIGHT, WIDTH, 3 if name in ("S", "rho") else 1)
    answer = service.http.get(f"/v1/mattes/{matte}/layers/{name}.png")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png")
    pixels = integer_formats.decode(answer.content, memory=1 << 24)
    assert pixels.dtype == np.uint16
    np.testing.assert_allclose(integer_formats.to_unit(pixels), np.clip(exact, 0, 1), atol=1e-5)


def test_all_layers_in_one_exr_with_the_requested_lobes(service: Service, matte: str) -> None:
    for query, lobes in (("", 4), ("?lobes=2", 2)):
        answer = service.http.get(f"/v1/mattes/{matte}/layers/all.exr{query}")
        assert answer.status_code == 200
        with OpenEXR.File(io.BytesIO(answer.content), separate_channels=True) as file:
            channels = file.channels()
            assert file.header()["monitor"].tolist() == [1280, 960]
            weights = [name for name in channels if name.endswith(".weight.R")]
            assert weights == [f"lobe{k}.weight.R" for k in range(lobes)]
            held = sum(channels[name].pixels.astype(float) for name in weights)
            lit = channels["rho.R"].pixels > 0.1  # darker pixels, at the ball's edge, have no direction
            assert lit.mean() > 0.98
            np.testing.assert_allclose(held[lit], channels["A"].pixels[lit], atol=2e-3)


def test_stmap_points_at_the_monitor(service: Service, matte: str) -> None:
    pixels = float_formats.decode(service.client.layer(matte, "stmap.exr"), memory=1 << 24)
    # beside the ball the monitor is seen as it is: u to the right, v up
    beside = np.median(pixels[:, :3, 0]), np.median(pixels[:, -3:, 0])
    assert beside[0] < beside[1]
    assert np.median(pixels[:2, :, 1]) > np.median(pixels[-2:, :, 1])
    # through the ball it is upside down
    assert np.median(pixels[20:22, 31:33, 1]) < np.median(pixels[26:28, 31:33, 1])
    assert set(np.unique(pixels[..., 2])) <= {0, 1}
    assert (pixels[..., 2] == 1).mean() > 0.98  # the rest is dark, at the ball's edge


@pytest.mark.parametrize("file", ["T.png", "stmap.png", "all.png", "S.jpg", "S", ".exr"])
def test_unknown_layer_names_the_known_ones(service: Service, matte: str, file: str) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/layers/{file}")
    assert (answer.status_code, answer.headers["content-type"]) == (404, PROBLEM)
    for known in ("S.png", "confidence.exr", "stmap.exr", "all.exr"):
        assert known in answer.json()["detail"]


@pytest.mark.parametrize("value", ["0", "17", "many"])
@pytest.mark.parametrize(("file", "name"), [("all.exr", "lobes"), ("lookups.exr", "lookups")])
def test_lobe_count_outside_the_limits_is_refused(
    service: Service, matte: str, file: str, name: str, value: str
) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/layers/{file}", params={name: value})
    assert (answer.status_code, answer.json()["field"]) == (422, name)


def test_pixel_lists_where_its_light_comes_from(service: Service, matte: str) -> None:
    found = service.http.get(f"/v1/mattes/{matte}/transport", params={"x": 50, "y": 30}).json()
    assert (found["x"], found["y"], found["recovered"], found["monitor"]) == (50, 30, True, [1280, 960])
    cells = np.array([cell["weight"] for cell in found["cells"]])
    np.testing.assert_allclose(cells.sum(axis=0), 1, atol=1e-5)
    lobes = np.array([lobe["weight"] for lobe in found["lobes"]])
    np.testing.assert_allclose(lobes.sum(axis=0), 1, atol=1e-5)
    for name in ("u", "v"):
        of_cells, of_lobes = (np.array([one[name] for one in found[kind]]) for kind in ("cells", "lobes"))
        assert ((of_cells > 0) & (of_cells < 1)).all()
        np.testing.assert_allclose(of_lobes @ lobes.mean(axis=1), of_cells @ cells.mean(axis=1), atol=1e-5)
    heaviest = service.client.layer(matte, "stmap.exr")
    place = float_formats.decode(heaviest, memory=1 << 24)[30, 50]
    np.testing.assert_allclose([found["lobes"][0]["u"], found["lobes"][0]["v"]], place[:2], rtol=1e-6)


def test_pixel_is_drawn(service: Service, matte: str) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/transport.png", params={"x": 50, "y": 30})
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png")
    with Image.open(io.BytesIO(answer.content)) as drawn:
        assert drawn.width > 900
        pixels = np.asarray(drawn).astype(int)
    red, green, blue = (
        np.count_nonzero((pixels.argmax(axis=2) == c) & (np.ptp(pixels, axis=2) > 60)) for c in range(3)
    )
    assert min(red, green, blue) > 50


@pytest.mark.parametrize("file", ["transport", "transport.png"])
@pytest.mark.parametrize(
    ("place", "field", "limit"), [((64, 0), "x", 63), ((0, 48), "y", 47), ((0, -1), "y", 47)]
)
def test_pixel_outside_is_refused(
    service: Service, matte: str, file: str, place: tuple[int, int], field: str, limit: int
) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/{file}", params=dict(zip("xy", place, strict=True)))
    assert (answer.status_code, answer.headers["content-type"]) == (422, PROBLEM)
    problem = answer.json()
    assert (problem["field"], problem["limit"]) == (field, limit)
    assert str(limit) in problem["detail"]


def test_the_command_writes_a_folder_of_layers(service: Service, matte: str, tmp_path: Path) -> None:
    out = tmp_path / "layers"
    done = CliRunner().invoke(main, ["layers", matte, str(out), "--url", service.url, "--json"])
    assert done.exit_code == 0, done.output
    written = json.loads(done.output)["layers"]
    assert sorted(path.name for path in out.iterdir()) == sorted(written)
    assert (out / "stmap.exr").read_bytes() == service.client.layer(matte, "stmap.exr")


@pytest.mark.parametrize(
    ("tool", "files", "last"),
    [
        ("blender", {"blender.py"}, "'lookups': 16"),
        ("nuke", {"nuke.nk", "nuke_stmap.nk"}, " name add15\n"),
    ],
)
def test_the_command_writes_the_node_of_a_tool(
    service: Service, matte: str, tmp_path: Path, tool: str, files: set[str], last: str
) -> None:
    out = tmp_path / tool
    done = CliRunner().invoke(main, ["layers", matte, str(out), "--for", tool, "--url", service.url])
    assert done.exit_code == 0, done.output
    assert {path.name for path in out.iterdir()} == {"lookups.exr", *files}
    assert all(last in (out / file).read_text() for file in files)
    with OpenEXR.File(str(out / "lookups.exr"), separate_channels=True) as held:
        lookups = [name for name in held.channels() if name.startswith("lookup") and name.endswith(".R")]
        assert len(lookups) == 16
