"""A glass of envmatte as a node of Blender's compositor: a backdrop goes in, the glass in front of it comes out.

Keep this file beside `lookups.exr`. In Blender, open it in the text editor and run it: the compositor gets a group of
nodes. Connect any linear picture, clip or render to its input, and the output to what it leads to. The backdrop
stretches over the monitor that the glass was filmed before, unless the node was made for a plate of the frame: that is
what the glass goes over. Or without a window::

    blender -b -P blender.py -- --backdrop sky.exr --output glass.exr --save glass.blend

With ``--material`` it makes a material as well, for a plane of the frame's aspect in front of a still backdrop.

`python` with the package `bpy` does the same as `blender -b -P`. It takes Blender 4.5. Blender 5 opens what that saves.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import bpy

MATTE: dict[str, Any] = {}
FINEST_TAPS, MOST_TAPS = 4, 16
"""Samples of the backdrop in each cell of the first level, along an axis, at least and at most."""
Value = Any  # a socket, or a number


class Nodes:
    """The nodes of a group of the compositor, or of a material, each made by the arithmetic that it does."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, str]],
        outputs: Sequence[tuple[str, str]] = (("Image", "Color"),),
        family: str = "Compositor",
    ) -> None:
        self.family = family
        self.tree = bpy.data.node_groups.new(name, f"{family}NodeTree")
        for direction, sockets in (("INPUT", inputs), ("OUTPUT", outputs)):
            for label, kind in sockets:
                self.tree.interface.new_socket(label, in_out=direction, socket_type=f"NodeSocket{kind}")
        self.inputs = self.tree.nodes.new("NodeGroupInput").outputs

    def add(self, kind: str, *values: Value, **settings: Any) -> Any:
        """Add a node, with its inputs linked or set; return its outputs."""
        node = self.tree.nodes.new(f"{self.family}Node{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs

    def math(self, operation: str, *values: Value) -> Value:
        return self.add("Math", *values, operation=operation)[0]

    def mix(self, blend: str, share: Value, first: Value, second: Value) -> Value:
        return self.add("MixRGB", share, first, second, blend_type=blend)[0]

    def group(self, tree: Any, *values: Value) -> Value:
        return self.add("Group", *values, node_tree=tree)[0]

    def look_up(self, light: Value, u: Value, v: Value) -> Value:
        """The pixel of `light` at (u, v)."""
        place = self.add("CombineXYZ", u, v, 1.0)[0]  # the third is what Map UV takes for alpha
        return self.add("MapUV", light, place, filter_type="NEAREST")[0]

    def between(self, value: Value, low: float, high: float) -> Value:
        return self.math("MAXIMUM", self.math("MINIMUM", value, high), low)

    def texture(self, image: Any, place: Value, interpolation: str = "Closest") -> Value:
        """What a picture shows at a place; beyond its edges it goes on."""
        return self.add("TexImage", place, image=image, interpolation=interpolation, extension="EXTEND")[0]

    def finish(self, *results: Value) -> Any:
        group = self.tree.nodes.new("NodeGroupOutput")
        for result, socket in zip(results, group.inputs, strict=False):
            self.tree.links.new(result, socket)
        for n, node in enumerate(self.tree.nodes):
            node.location = 180 * (n // 12), -170 * (n % 12)
        return self.tree


def grid(nodes: Nodes, size: tuple[int, int]) -> tuple[Value, Value]:
    """u and v of the pixels of a picture of a size."""
    name = f"envmatte {size[0]} x {size[1]}"
    picture = bpy.data.images.get(name) or bpy.data.images.new(name, *size)
    picture.use_fake_user = True
    normalised = nodes.add("ImageCoordinates", nodes.add("Image", image=picture)[0])[1]
    u, v, _ = nodes.add("SeparateXYZ", normalised)
    return u, v


def resampled(
    nodes: Nodes, light: Value, size: tuple[int, int], axis: int, places: list[tuple[Any, float]]
) -> Value:
    """Light on a grid of a size: the weighted sum of what `light` shows at some places along an axis.

    A place is a function of the column or row, counted from the top left: it returns the coordinate from 0 to 1.
    """
    u, v = grid(nodes, size)
    along = u if axis == 0 else nodes.math("SUBTRACT", 1.0, v)
    number = nodes.math("FLOOR", nodes.math("MULTIPLY", along, float(size[axis])))
    total = None
    for place, weight in places:
        at = place(number)
        seen = (
            nodes.look_up(light, at, v)
            if axis == 0
            else nodes.look_up(light, u, nodes.math("SUBTRACT", 1.0, at))
        )
        seen = nodes.mix("MULTIPLY", 1.0, seen, (weight, weight, weight, 1))
        total = seen if total is None else nodes.mix("ADD", 1.0, total, seen)
    return total


def first_level(cells: tuple[int, int], taps: int) -> Any:
    """A group that averages a picture over each cell."""
    nodes = Nodes("envmatte cells", [("Image", "Color")])
    light = nodes.inputs[0]

    def places(count: int) -> list[tuple[Any, float]]:
        def place(tap: int) -> Any:
            share = (tap + 0.5) / taps / count
            return lambda number: nodes.math("MULTIPLY_ADD", number, 1 / count, share)

        return [(place(tap), 1 / taps) for tap in range(taps)]

    columns, rows = cells
    light = resampled(nodes, light, (columns, rows * taps), 0, places(columns))
    return nodes.finish(resampled(nodes, light, cells, 1, places(rows)))


def next_level(fine: tuple[int, int], coarse: tuple[int, int]) -> Any:
    """A group that halves a level, with the weights [1, 3, 3, 1] / 8 along each axis; the edge is repeated."""
    nodes = Nodes(f"envmatte {fine[0]} to {coarse[0]} columns", [("Image", "Color")])
    light = nodes.inputs[0]

    def places(count: int) -> list[tuple[Any, float]]:
        def place(shift: int) -> Any:
            def at(number: Value) -> Value:
                node = nodes.between(nodes.math("MULTIPLY_ADD", number, 2.0, float(shift)), 0.0, count - 1.0)
                return nodes.math("DIVIDE", nodes.math("ADD", node, 0.5), float(count))

            return at

        return [(place(shift), weight / 8) for shift, weight in ((-1, 1), (0, 3), (1, 3), (2, 1))]

    light = resampled(nodes, light, (coarse[0], fine[1]), 0, places(fine[0]))
    return nodes.finish(resampled(nodes, light, coarse, 1, places(fine[1])))


def between_pixels(nodes: Nodes, light: Value, places: Sequence[Value], counts: Sequence[Value]) -> Value:
    """What `light` shows at places across and down, in pixels from the centre of its top left one; bilinear."""
    coordinates, shares = [], []
    for place, count in zip(places, counts, strict=True):
        last = nodes.math("SUBTRACT", count, 1.0)
        at = nodes.between(place, 0.0, last)
        first = nodes.math("FLOOR", at)
        second = nodes.math("MINIMUM", nodes.math("ADD", first, 1.0), last)
        shares.append(nodes.math("SUBTRACT", at, first))
        coordinates.append([nodes.math("DIVIDE", nodes.math("ADD", n, 0.5), count) for n in (first, second)])
    up = [nodes.math("SUBTRACT", 1.0, down) for down in coordinates[1]]
    rows = [
        nodes.mix("MIX", shares[0], *(nodes.look_up(light, across, v) for across in coordinates[0]))
        for v in up
    ]
    return nodes.mix("MIX", shares[1], *rows)


def bilinear(level: int, size: tuple[int, int]) -> Any:
    """A group that looks up places in a level: x and y, in cells of the first one, from its top left."""
    nodes = Nodes(f"envmatte look-up in level {level}", [("Image", "Color"), ("x", "Float"), ("y", "Float")])
    light, x, y = nodes.inputs[0], nodes.inputs[1], nodes.inputs[2]
    places = [nodes.math("MULTIPLY_ADD", place, 0.5**level, -0.5) for place in (x, y)]
    return nodes.finish(between_pixels(nodes, light, places, [float(count) for count in size]))


def levels_of(taps: int) -> list[Any]:
    """Groups that make the levels of the backdrop, each of the one before, the first of the backdrop."""
    sizes = MATTE["levels"]
    first = first_level(sizes[0], taps)
    if MATTE["plate"]:
        first = of_plate(first, (sizes[0][0] * taps, sizes[0][1] * taps))
    return [first, *(next_level(*pair) for pair in pairwise(sizes))]


def of_plate(first: Any, size: tuple[int, int]) -> Any:
    """A group that shows the monitor a plate of the frame, by the perspective of the camera, and makes its first level.

    Beyond the plate's edges it goes on as there.
    """
    nodes = Nodes("envmatte plate", [("Image", "Color")])
    light = nodes.inputs[0]
    u, v = grid(nodes, size)
    y = nodes.math("SUBTRACT", 1.0, v)
    across, down, depth = (
        nodes.math("ADD", nodes.math("MULTIPLY_ADD", u, of_x, one), nodes.math("MULTIPLY", y, of_y))
        for of_x, of_y, one in MATTE["plate"]["place"]
    )
    wide, high, _ = nodes.add("SeparateXYZ", nodes.add("ImageInfo", light)["Dimensions"])
    places = [
        nodes.math("MULTIPLY_ADD", nodes.math("DIVIDE", value, depth), count, -0.5)
        for value, count in ((across, wide), (down, high))
    ]
    return nodes.finish(nodes.group(first, between_pixels(nodes, light, places, (wide, high))))


def glass(exr: Path, taps: int) -> Any:
    """The group of the matte."""
    levels = MATTE["levels"]
    columns, rows = levels[0]
    nodes = Nodes(MATTE["name"], [("Backdrop", "Color")])
    held = bpy.data.images.load(str(exr), check_existing=True)
    layers = nodes.add("Image", image=held)
    light, pyramid = nodes.inputs[0], []
    for level_group in levels_of(taps):
        light = nodes.group(level_group, light)
        pyramid.append(light)
    samplers = [bilinear(level, size) for level, size in enumerate(levels)]
    arrived = (0.0, 0.0, 0.0, 1.0)
    for k in range(MATTE["lookups"]):
        u, v, level, _ = nodes.add("SeparateColor", layers[f"lookup{k}"])
        x = nodes.math("MULTIPLY", u, float(columns))
        y = nodes.math("MULTIPLY", nodes.math("SUBTRACT", 1.0, v), float(rows))
        for n, light in enumerate(pyramid):
            distance = nodes.math("ABSOLUTE", nodes.math("SUBTRACT", level, float(n)))
            share = nodes.math("MAXIMUM", nodes.math("SUBTRACT", 1.0, distance), 0.0)
            weight = nodes.mix("MULTIPLY", 1.0, layers[f"weight{k}"], share)
            seen = nodes.mix("MULTIPLY", 1.0, weight, nodes.group(samplers[n], light, x, y))
            arrived = nodes.mix("ADD", 1.0, arrived, seen)
    result = seen_by_camera(nodes, nodes.mix("MULTIPLY", 1.0, layers["rho"], arrived), layers["S"])
    return nodes.finish(nodes.add("SetAlpha", result, layers["Alpha"], mode="REPLACE_ALPHA")[0])


def seen_by_camera(nodes: Nodes, through: Value, added: Value) -> Value:
    """What comes through, as the camera tells its colours apart, with the light that the glass adds."""
    seen = nodes.mix("ADD", 1.0, added, turned(nodes, through, MATTE["crosstalk"]))
    return turned(nodes, seen, MATTE["plate"]["exposure"]) if MATTE["plate"] else seen


def turned(nodes: Nodes, colour: Value, matrix: Sequence[Sequence[float]]) -> Value:
    """The product of a matrix and a colour; by numbers, for a colour that is set has no negative ones."""
    red, green, blue, *_ = nodes.add("SeparateColor", colour)
    rows = [
        nodes.math(
            "MULTIPLY_ADD", red, a, nodes.math("MULTIPLY_ADD", green, b, nodes.math("MULTIPLY", blue, c))
        )
        for a, b, c in matrix
    ]
    return nodes.add("CombineColor", *rows)[0]


def baked(exr: Path, backdrop: Any, taps: int) -> dict[str, Any]:
    """The layers of the EXR and the levels of a backdrop, each a picture of its own: textures know no layers."""
    scene = bpy.data.scenes.new("envmatte bake")
    scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()

    def shown(kind: str, **settings: Any) -> Any:
        node = nodes.new(f"CompositorNode{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    layers = shown("Image", image=bpy.data.images.load(str(exr), check_existing=True)).outputs
    numbers = range(MATTE["lookups"])
    sockets = {name: layers[name] for k in numbers for name in (f"lookup{k}", f"weight{k}")}
    sockets |= {name: layers[name] for name in ("S", "rho", "Alpha")}
    light = shown("Image", image=backdrop).outputs[0]
    for n, tree in enumerate(levels_of(taps)):
        level = shown("Group", node_tree=tree)
        links.new(light, level.inputs[0])
        sockets[f"level{n}"] = light = level.outputs[0]
    with tempfile.TemporaryDirectory() as place:
        output = shown("OutputFile", base_path=place)
        output.format.file_format, output.format.color_mode = "OPEN_EXR", "RGB"
        output.format.color_depth = "32"
        output.file_slots.clear()
        for name, socket in sockets.items():
            output.file_slots.new(f"{name}_")
            links.new(socket, output.inputs[-1])
        scene.render.compositor_device, scene.render.compositor_precision = "CPU", "FULL"
        scene.render.resolution_x, scene.render.resolution_y = MATTE["size"]
        scene.render.resolution_percentage = 100
        bpy.ops.render.render(scene=scene.name)
        images = {}
        for name in sockets:
            (path,) = Path(place).glob(f"{name}_*.exr")
            images[name] = bpy.data.images.load(str(path))
            images[name].name = f"envmatte {name}"
            images[name].colorspace_settings.name = "Non-Color"
            images[name].pack()
    bpy.data.scenes.remove(scene)
    return images


def glass_shader(images: dict[str, Any]) -> Any:
    """The group of the matte for materials, in front of the backdrop of these pictures."""
    sockets = [("Color", "Color"), ("Alpha", "Float")]
    nodes = Nodes(f"{MATTE['name']} material", [("Vector", "Vector")], sockets, "Shader")
    place = nodes.inputs[0]
    columns, rows = MATTE["levels"][0]
    arrived: Value = (0.0, 0.0, 0.0, 1.0)
    # Cycles keeps what a node makes until it is used, and has room for little. So nodes are made in the order of their
    # use, and colours stay colours: conversions would all come last.
    for k in range(MATTE["lookups"]):
        u, v, level = nodes.add("SeparateColor", nodes.texture(images[f"lookup{k}"], place))
        seen = None
        for n, (across, down) in enumerate(MATTE["levels"]):
            wide, high = columns / 2**n / across, rows / 2**n / down
            x, y = nodes.math("MULTIPLY", u, wide), nodes.math("MULTIPLY_ADD", v, high, 1 - high)
            there = nodes.add("CombineXYZ", x, y, 0.0)[0]
            light = nodes.texture(images[f"level{n}"], there, "Linear")
            if seen is None:
                seen = light
            else:
                share = nodes.add("Math", level, n - 1.0, operation="SUBTRACT", use_clamp=True)[0]
                seen = nodes.mix("MIX", share, seen, light)
        lit = nodes.mix("MULTIPLY", 1.0, nodes.texture(images[f"weight{k}"], place), seen)
        arrived = nodes.mix("ADD", 1.0, arrived, lit)
    through = nodes.mix("MULTIPLY", 1.0, nodes.texture(images["rho"], place), arrived)
    result = seen_by_camera(nodes, through, nodes.texture(images["S"], place))
    return nodes.finish(result, nodes.texture(images["Alpha"], place))


def material(group: Any) -> Any:
    """A material for a plane of the frame's aspect: it emits what the glass shows, and is clear elsewhere."""
    made = bpy.data.materials.new(MATTE["name"])
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    place, glass, light, clear, both, output = (
        nodes.new(f"ShaderNode{kind}")
        for kind in ("TexCoord", "Group", "Emission", "BsdfTransparent", "MixShader", "OutputMaterial")
    )
    glass.node_tree = group
    for one, other in (
        (place.outputs["UV"], glass.inputs[0]),
        (glass.outputs["Color"], light.inputs["Color"]),
        (glass.outputs["Alpha"], both.inputs[0]),
        (clear.outputs[0], both.inputs[1]),
        (light.outputs[0], both.inputs[2]),
        (both.outputs[0], output.inputs["Surface"]),
    ):
        links.new(one, other)
    for n, node in enumerate((place, glass, light, clear, both, output)):
        node.location = 200 * n, 0
    made.use_fake_user = True
    return made


def folder() -> Path:
    """Where this script lies: in Blender's text editor ``__file__`` is only its name."""
    text = bpy.data.texts.get(Path(__file__).name)
    return Path(bpy.path.abspath(text.filepath) if text else __file__).resolve().parent


def show_all_frames(scene: Any, backdrop: Any) -> None:
    """Let a clip move, which is its first frame otherwise, and the scene last as long as it."""
    fps = bpy.data.movieclips.load(bpy.path.abspath(backdrop.image.filepath)).fps
    scene.render.fps, scene.render.fps_base = round(fps), round(fps) / fps
    scene.frame_start, scene.frame_end = 1, backdrop.image.frame_duration
    backdrop.frame_duration = backdrop.image.frame_duration


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--backdrop", type=Path, help="A picture, linear light if it is an EXR; or a clip.")
    parser.add_argument("--output", type=Path, help="An EXR to render, of a clip's first frame.")
    parser.add_argument("--save", type=Path, help="A .blend to write.")
    parser.add_argument(
        "--material", action="store_true", help="Make a material of the glass before the backdrop."
    )
    given = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
    if given.output and given.output.suffix.lower() != ".exr":
        parser.error("--output must end in .exr")  # Blender would write it under another name
    if not (4, 5) <= bpy.app.version < (5,):
        # And not SystemExit, which would close the window of the text editor.
        raise RuntimeError(
            f"this script takes Blender 4.5, and this is {bpy.app.version_string}: run it with --save in Blender 4.5. "
            "Blender 5 opens the .blend that it saves"
        )
    scene = bpy.context.scene
    scene.use_nodes = True
    if given.output:  # a scene of its own, without the cube and the render that new scenes show
        scene.node_tree.nodes.clear()
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    size, backdrop = MATTE["levels"][0], None
    if given.backdrop:
        backdrop = nodes.new("CompositorNodeImage")
        backdrop.image = bpy.data.images.load(str(given.backdrop.resolve()))
        size = backdrop.image.size
        if backdrop.image.source == "MOVIE":
            if given.material:
                parser.error("--material needs a still as --backdrop")
            show_all_frames(scene, backdrop)
    # Samples fall on pixels where the cells have a whole number of them.
    pixels = max(-(-n // cells) for n, cells in zip(size, MATTE["levels"][0], strict=True))
    taps = min(pixels * -(-FINEST_TAPS // pixels), MOST_TAPS)
    group = nodes.new("CompositorNodeGroup")
    group.node_tree, group.label, group.width = glass(folder() / "lookups.exr", taps), MATTE["name"], 200
    group.location = 300, 600
    if not any(
        node.bl_idname == "CompositorNodeComposite" for node in nodes
    ):  # else what is there stays the output
        output = nodes.new("CompositorNodeComposite")
        output.location = 600, 600
        links.new(group.outputs[0], output.inputs[0])
    if backdrop:
        links.new(backdrop.outputs[0], group.inputs[0])
    if given.material:
        if not backdrop:
            parser.error("--material needs a --backdrop")
        material(glass_shader(baked(folder() / "lookups.exr", backdrop.image, taps)))
    if given.output:
        scene.render.resolution_x, scene.render.resolution_y = MATTE["size"]
        scene.render.resolution_percentage = 100
        scene.render.compositor_device, scene.render.compositor_precision = "CPU", "FULL"
        kept = scene.render.image_settings
        kept.file_format, kept.color_mode, kept.color_depth = "OPEN_EXR", "RGBA", "32"
        scene.render.filepath = str(given.output.resolve())
        bpy.ops.render.render(write_still=True)
    if given.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(given.save.resolve()))


if __name__ == "__main__":
    main()
