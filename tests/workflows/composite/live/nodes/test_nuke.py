"""The node of Nuke: its script parsed, and its kernels run by a C++ compiler. Nuke itself is not there to run it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import (
    BESIDE,
    backdrops,
    draw,
    few_nodes,
    plate_and_backdrop,
    psnr,
    read_channels,
    recovered,
)
from tests.workflows.composite.live.nodes.nuke_script import CLASSES, Node, parse, run
from workflows.composite import composite
from workflows.composite.backdrops.around import Plate, expose, plate_of
from workflows.composite.live.nodes import FILES
from workflows.composite.live.nodes.exr import LOOKUPS, write_lookups

needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="g++, which runs the kernels, is not installed"
)


def written(matte: Matte, folder: Path, lookups: int, script: str = "nuke.nk", **plate: Plate) -> str:
    with (folder / "lookups.exr").open("wb") as file:
        write_lookups(matte, file, lookups)
    with (folder / script).open("wb") as file:
        FILES[script](matte, file, lookups, **plate)
    return (folder / script).read_text()


def measure_blurs(matte: Matte, folder: Path, lookups: int) -> dict[str, float]:
    """PSNR of the node without kernels against the service's composite, before each backdrop."""
    _, nodes = parse(written(matte, folder, lookups, "nuke_stmap.nk"))
    channels, _ = read_channels(folder / "lookups.exr")
    found = {}
    for kind, backdrop in backdrops().items():
        expected = composite(matte, backdrop)
        opaque = np.concatenate([backdrop, np.ones_like(backdrop[..., :1])], axis=-1)
        found[kind] = psnr(run(nodes, opaque, channels, folder), expected, expected[..., 3] > 0)
    return found


def test_nodes_knobs_and_connections(objects: Objects, tmp_path: Path) -> None:
    group, nodes = parse(written(few_nodes(objects, 3), tmp_path, 2))
    assert group.knobs["name"] == "envmatte_glass"
    by_name = {node.knobs["name"]: node for node in nodes}
    assert len(by_name) == len(nodes)
    for node in nodes:
        assert node.kind in CLASSES
        assert len(node.inputs) == (CLASSES[node.kind] if node.kind != "BlinkScript" else len(node.inputs))

    def inputs(name: str) -> list[str]:
        return [one.knobs["name"] for one in by_name[name].inputs]

    assert inputs("cells") == ["canvas", "whole"]
    assert (inputs("level1"), inputs("level2")) == (["cells"], ["level1"])
    assert inputs("add0") == ["lookup0", "weight0", "dark", "level2"]
    assert inputs("add1") == ["lookup1", "weight1", "add0", "level2"]
    assert (inputs("through"), inputs("crosstalk")) == (["add1", "rho"], ["through"])
    assert (inputs("glass"), inputs("alpha")) == (["crosstalk", "S"], ["glass", "lookups"])
    assert inputs("image") == ["frame"]
    assert by_name["lookups"].knobs["raw"] == "true"
    assert by_name["lookups"].knobs["file"] == r'"\[file dirname \[value root.name\]\]/lookups.exr"'
    assert by_name["frame"].knobs["box"] == "{0 0 35 20}"
    assert 'columns, "columns", 75)' in by_name["cells"].kernel
    assert _unconnected(nodes) == {"image"}


@needs_compiler
def test_kernels_draw_the_composite_where_lookups_suffice(objects: Objects, tmp_path: Path) -> None:
    matte = few_nodes(objects, 3)
    _, nodes = parse(written(matte, tmp_path, 3))
    channels, _ = read_channels(tmp_path / "lookups.exr")
    backdrop = np.random.default_rng(1).random((90, 200, 3), np.float32)
    seen = run(nodes, backdrop, channels, tmp_path)
    np.testing.assert_allclose(seen, composite(matte, backdrop), atol=1e-3)  # half floats
    np.testing.assert_allclose(seen[..., :3], draw(tmp_path / "lookups.exr", backdrop), atol=2e-5)


@needs_compiler
@pytest.mark.parametrize(("script", "least"), [("nuke.nk", 50), ("nuke_stmap.nk", 38)])
def test_a_plate_of_the_frame_is_what_the_monitor_shows(
    objects: Objects, tmp_path: Path, script: str, least: float
) -> None:
    matte = few_nodes(objects, 3, beside=BESIDE)
    _, nodes = parse(written(matte, tmp_path, 3, script, plate=plate_of(matte)))
    channels, _ = read_channels(tmp_path / "lookups.exr")
    plate, backdrop = plate_and_backdrop(matte)
    opaque = np.concatenate([plate, np.ones_like(plate[..., :1])], axis=-1)
    expected = expose(matte, composite(matte, backdrop))
    seen = run(nodes, opaque, channels, tmp_path)
    np.testing.assert_array_equal(seen[..., 3], expected[..., 3])
    assert psnr(seen, expected, expected[..., 3] > 0) > least


def test_nodes_without_kernels(objects: Objects, tmp_path: Path) -> None:
    group, nodes = parse(written(few_nodes(objects, 3), tmp_path, 2, "nuke_stmap.nk"))
    assert group.knobs["name"] == "envmatte_glass_stmap"
    by_name = {node.knobs["name"]: node for node in nodes}
    assert len(by_name) == len(nodes)
    assert {node.kind for node in nodes} <= CLASSES.keys() - {"BlinkScript", "Group"}
    assert all(len(node.inputs) == CLASSES[node.kind] for node in nodes)

    def inputs(name: str) -> list[str]:
        return [one.knobs["name"] for one in by_name[name].inputs]

    levels = [node for node in nodes if node.kind == "Blur"]
    assert [node.knobs["name"] for node in levels] == ["blur0", "blur1", "blur2"]
    assert {inputs(node.knobs["name"])[0] for node in levels} == {"whole"}
    assert by_name["whole"].knobs["crop"] == "false"  # edges repeated, rather than black
    for k in range(2):
        assert inputs(f"place{k}") == [f"lookup{k}"]
        for n in range(3):
            assert inputs(f"level{n}") == [f"blur{n}", "halves"]
            assert inputs(f"look{k}_{n}") == [f"level{n}", f"place{k}"]
            assert inputs(f"share{k}_{n}") == [f"place{k}", f"look{k}_{n}"]
        assert inputs(f"seen{k}_1") == [f"share{k}_0", f"share{k}_1"]
        assert inputs(f"seen{k}_2") == [f"seen{k}_1", f"share{k}_2"]
        assert inputs(f"lit{k}") == [f"weight{k}", f"seen{k}_2"]
    assert inputs("add1") == ["lit0", "lit1"]
    assert inputs("through") == ["add1", "rho"]
    assert _unconnected(nodes) == {"image"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lens", "ball", "tumbler"])
def test_blurs_draw_nearly_the_composite(objects: Objects, tmp_path: Path, name: str) -> None:
    found = measure_blurs(recovered(objects, name), tmp_path, LOOKUPS)
    least = {"photo": 49, "strokes": 49, "ramp": 78, "tiles": 41, "checker": 39.5}
    assert {kind: value for kind, value in found.items() if value < least[kind]} == {}


def _unconnected(nodes: list[Node]) -> set[str]:
    """The names of nodes that no other takes."""
    taken = {id(one) for node in nodes for one in node.inputs}
    return {node.knobs["name"] for node in nodes if id(node) not in taken}
