"""The nodes of Blender, made and rendered by Blender itself, without a window."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import (
    BESIDE,
    Image,
    backdrops,
    draw,
    few_nodes,
    plate_and_backdrop,
    psnr,
    read_channels,
    recovered,
    write_picture,
)
from workflows.composite import composite
from workflows.composite.backdrops.around import Plate, expose, plate_of
from workflows.composite.live.nodes.blender import write_blender
from workflows.composite.live.nodes.exr import LOOKUPS, write_lookups
from workflows.images.tone_curves import to_light

needs_blender = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None,
    reason="Blender is not installed (on Python 3.11: pip install --no-deps bpy==4.5.0)",
)
BARS = {"photo": 45, "strokes": 45, "ramp": 45, "checker": 40, "tiles": 40}
"""PSNR of the nodes against the service's composite, at least."""


def write_nodes(matte: Matte, folder: Path, lookups: int, plate: Plate | None = None) -> None:
    with (folder / "lookups.exr").open("wb") as file:
        write_lookups(matte, file, lookups)
    with (folder / "blender.py").open("wb") as file:
        write_blender(matte, file, lookups, plate)


def render(folder: Path, backdrop: Image, *more: str) -> Image:
    """What Blender makes of the nodes in a folder, (height, width, 4)."""
    write_picture(folder / "backdrop.exr", backdrop)
    files = ["--backdrop", str(folder / "backdrop.exr"), "--output", str(folder / "glass.exr"), *more]
    command = [sys.executable, str(folder / "blender.py"), "--", *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    channels, _ = read_channels(folder / "glass.exr")
    return np.stack([channels[c] for c in "RGBA"], axis=-1)


def test_the_script_has_the_figures_of_the_matte(objects: Objects, tmp_path: Path) -> None:
    write_nodes(few_nodes(objects, 3), tmp_path, 4)
    script = (tmp_path / "blender.py").read_text()
    compile(script, "blender.py", "exec")
    assert "((75, 37), (38, 19), (19, 10))" in script
    assert "'lookups': 4" in script


@needs_blender
def test_blender_draws_the_composite_where_lookups_suffice(objects: Objects, tmp_path: Path) -> None:
    matte = few_nodes(objects, 3)
    write_nodes(matte, tmp_path, 3)
    backdrop = np.random.default_rng(1).random((74, 150, 3), np.float32)
    seen = render(tmp_path, backdrop, "--save", str(tmp_path / "glass.blend"))
    expected = composite(matte, backdrop)
    np.testing.assert_allclose(seen, expected, atol=2e-3)
    assert (tmp_path / "glass.blend").stat().st_size > 1000


@needs_blender
def test_backdrop_of_any_size_is_averaged_over_the_cells(objects: Objects, tmp_path: Path) -> None:
    matte = few_nodes(objects, 3)
    write_nodes(matte, tmp_path, 3)
    y, x = np.mgrid[:90, :200]
    backdrop = np.stack([x / 200, y / 90, 0.5 + 0.4 * np.sin(x / 20)], axis=-1).astype(np.float32)
    expected = composite(matte, backdrop)
    assert psnr(render(tmp_path, backdrop), expected, expected[..., 3] > 0) > 50


FRAME = """
import sys, bpy
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
scene = bpy.context.scene
print(scene.frame_start, scene.frame_end, scene.render.fps / scene.render.fps_base)
scene.frame_set(scene.frame_end)
bpy.ops.render.render(write_still=True)
"""
"""Renders the last frame of a .blend."""


@needs_blender
def test_a_clip_moves_in_what_is_saved(objects: Objects, tmp_path: Path) -> None:
    matte = few_nodes(objects, 3)
    write_nodes(matte, tmp_path, 3)
    grey = 60, 120, 180
    with av.open(tmp_path / "clip.mp4", "w") as clip:
        stream = clip.add_stream("libx264", rate=25, width=150, height=74, pix_fmt="yuv420p")
        for value in grey:
            clip.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((74, 150, 3), value, np.uint8))))
        clip.mux(stream.encode())
    exr, blend = tmp_path / "glass.exr", tmp_path / "glass.blend"
    files = ["--backdrop", str(tmp_path / "clip.mp4"), "--output", str(exr), "--save", str(blend)]
    found = []
    for command in ([str(tmp_path / "blender.py"), "--", *files], ["-c", FRAME, str(blend)]):
        done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        found.append(read_channels(exr)[0]["G"])
    assert "1 3 25.0\n" in done.stdout
    for seen, value in zip(found, (grey[0], grey[-1]), strict=True):
        light = np.full((74, 150, 3), to_light(np.float32(value / 255), "srgb"), np.float32)
        np.testing.assert_allclose(seen, composite(matte, light)[..., 1], atol=0.02)
    command = [str(tmp_path / "blender.py"), "--", *files[:2], "--material"]
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert "--material needs a still" in done.stderr


@needs_blender
@pytest.mark.parametrize("material", [False, True])
def test_a_plate_of_the_frame_is_what_the_monitor_shows(
    objects: Objects, tmp_path: Path, material: bool
) -> None:
    matte = few_nodes(objects, 3, beside=BESIDE)
    write_nodes(matte, tmp_path, 3, plate_of(matte))
    plate, backdrop = plate_and_backdrop(matte)
    size = matte.width, matte.height
    seen = render_material(tmp_path, size, plate) if material else render(tmp_path, plate)
    expected = expose(matte, composite(matte, backdrop))
    np.testing.assert_array_equal(seen[..., 3], expected[..., 3])
    assert psnr(seen, expected, expected[..., 3] > 0) > 50


TEXT_EDITOR = """
import sys, bpy
text = bpy.data.texts.load(sys.argv[1])
names = {"__name__": "__main__", "__file__": "/untitled.blend/" + text.name}
exec(compile(text.as_string(), names["__file__"], "exec"), names)
(group,) = [node for node in bpy.context.scene.node_tree.nodes if node.bl_idname == "CompositorNodeGroup"]
(output,) = [node for node in bpy.context.scene.node_tree.nodes if node.bl_idname == "CompositorNodeComposite"]
(held,) = [node.image for node in group.node_tree.nodes if node.bl_idname == "CompositorNodeImage"]
print(group.label, [one.name for one in (*group.inputs, *group.outputs)], held.filepath, sep="|")
"""
"""Runs a script as the text editor does, where only the text's name is in ``__file__``."""


def test_an_output_that_blender_would_write_under_another_name_is_refused(
    objects: Objects, tmp_path: Path
) -> None:
    write_nodes(few_nodes(objects, 3), tmp_path, 3)
    (tmp_path / "bpy.py").touch()  # Blender's own module is not asked for anything
    command = [sys.executable, str(tmp_path / "blender.py"), "--", "--output", str(tmp_path / "glass.png")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert "--output must end in .exr" in done.stderr


@pytest.mark.parametrize("version", [(4, 4, 3), (5, 0, 1)])
def test_another_blender_is_named_with_what_to_do(
    objects: Objects, tmp_path: Path, version: tuple[int, ...]
) -> None:
    write_nodes(few_nodes(objects, 3), tmp_path, 3)
    number = ".".join(map(str, version))
    app = f"class app:\n    version, version_string = {version}, {number!r}\n"
    (tmp_path / "bpy.py").write_text(app)  # nothing else of it is needed
    done = subprocess.run(
        [sys.executable, str(tmp_path / "blender.py")], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 1
    message = done.stderr.splitlines()[-1]
    assert f"this is {number}: run it with --save in Blender 4.5" in message


@needs_blender
def test_the_text_editor_adds_a_group_and_leaves_the_output(objects: Objects, tmp_path: Path) -> None:
    write_nodes(few_nodes(objects, 3), tmp_path, 3)
    command = [sys.executable, "-c", TEXT_EDITOR, str(tmp_path / "blender.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = done.stdout.splitlines()[-1].split("|")
    assert found[:2] == ["envmatte glass", "['Backdrop', 'Image']"]
    assert found[2] == str(tmp_path / "lookups.exr")


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("name", ["ball", "lens", "tumbler"])
def test_blender_draws_a_recovered_glass(objects: Objects, tmp_path: Path, name: str) -> None:
    matte = recovered(objects, name)
    write_nodes(matte, tmp_path, LOOKUPS)
    for kind, backdrop in backdrops().items():
        seen, service = render(tmp_path, backdrop), composite(matte, backdrop)
        glass = service[..., 3] > 0
        np.testing.assert_array_equal(seen[..., 3], service[..., 3])
        assert psnr(seen, draw(tmp_path / "lookups.exr", backdrop), glass) > 80, kind
        assert psnr(seen, service, glass) > BARS[kind], kind


PLANE = """
import runpy, sys, bpy
script, width, height, backdrop, target = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:]
sys.argv = [script, "--", "--backdrop", backdrop, "--material"]
runpy.run_path(script, run_name="__main__")
scene = bpy.data.scenes.new("plane")
half = width / height / 2, 0.5
mesh = bpy.data.meshes.new("plane")
corners = [(-half[0], -half[1], 0), (half[0], -half[1], 0), (half[0], half[1], 0), (-half[0], half[1], 0)]
mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
for loop, uv in zip(mesh.uv_layers.new().data, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
    loop.uv = uv
mesh.materials.append(bpy.data.materials["envmatte glass"])
scene.collection.objects.link(bpy.data.objects.new("plane", mesh))
camera = bpy.data.cameras.new("camera")
camera.type, camera.ortho_scale = "ORTHO", max(width / height, 1)
scene.camera = bpy.data.objects.new("camera", camera)
scene.camera.location = 0, 0, 1
scene.collection.objects.link(scene.camera)
render = scene.render
render.engine = "CYCLES"
scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 1, False
scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 0.01
scene.cycles.use_adaptive_sampling = False
render.film_transparent = True
render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
kept = render.image_settings
kept.file_format, kept.color_mode, kept.color_depth = "OPEN_EXR", "RGBA", "32"
render.filepath = target
bpy.ops.render.render(scene=scene.name, write_still=True)
"""
"""Makes the material, puts it on a plane as large as the picture, and renders it by Cycles."""


def render_material(folder: Path, size: tuple[int, int], backdrop: Image) -> Image:
    """What Cycles makes of the material of a matte in a folder, (height, width, 4)."""
    write_picture(folder / "backdrop.exr", backdrop)
    files = [str(folder / name) for name in ("blender.py", "backdrop.exr", "glass.exr")]
    command = [sys.executable, "-c", PLANE, files[0], *map(str, size), *files[1:]]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "SVM" not in done.stderr  # Cycles ends with 0 where a material is too large for it
    channels, _ = read_channels(folder / "glass.exr")
    return np.stack([channels[c] for c in "RGBA"], axis=-1)


@needs_blender
def test_the_material_draws_the_composite_where_lookups_suffice(objects: Objects, tmp_path: Path) -> None:
    matte = few_nodes(objects, 3)
    write_nodes(matte, tmp_path, 3)
    backdrop = np.random.default_rng(1).random((74, 150, 3), np.float32)
    seen = render_material(tmp_path, (matte.width, matte.height), backdrop)
    expected = composite(matte, backdrop)
    np.testing.assert_allclose(seen, expected, atol=2e-3)
    # Where nothing was recovered, the plane is clear.
    where = expected[..., 3] > 0
    np.testing.assert_allclose(seen[where, :3], draw(tmp_path / "lookups.exr", backdrop)[where], atol=1e-4)


@needs_blender
@pytest.mark.slow
def test_the_material_draws_a_recovered_glass(objects: Objects, tmp_path: Path) -> None:
    matte = recovered(objects, "lens")
    write_nodes(matte, tmp_path, LOOKUPS)
    for kind in ("photo", "checker"):
        backdrop = backdrops()[kind]
        seen, service = (
            render_material(tmp_path, (matte.width, matte.height), backdrop),
            composite(matte, backdrop),
        )
        np.testing.assert_array_equal(seen[..., 3], service[..., 3])
        assert psnr(seen, service, service[..., 3] > 0) > BARS[kind], kind
