"""A script of Nuke, parsed and run without Nuke: its nodes by numpy, its kernels by a C++ compiler."""

import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Image = NDArray[np.float32]
CLASSES = {
    "Group": 0,
    "Input": 0,
    "Read": 0,
    "Constant": 0,
    "Shuffle": 1,
    "BlinkScript": None,
    "Blur": 1,
    "Expression": 1,
    "STMap": 2,
    "Merge2": 2,
    "MergeExpression": 2,
    "ColorMatrix": 1,
    "Copy": 2,
    "Crop": 1,
    "Output": 1,
}
"""The nodes that may be there, and how many inputs each takes."""
SHIM = Path(__file__).with_name("blink.h")


@dataclass
class Node:
    """A node: its class, its knobs as they are written, and its inputs."""

    kind: str
    knobs: dict[str, str]
    inputs: list["Node"] = field(default_factory=list)

    @property
    def kernel(self) -> str:
        """The source of a BlinkScript node, as Nuke unescapes it."""
        text = self.knobs["kernelSource"]
        assert text[0] == text[-1] == '"'
        assert not re.search(r'(?<!\\)(?:\\\\)*["\[\]{}$]', text[1:-1])
        return re.sub(r"\\(.)", lambda found: {"n": "\n", "t": "\t"}.get(found[1], found[1]), text[1:-1])


def parse(text: str) -> tuple[Node, list[Node]]:
    """The group of a script, and the nodes within, connected as Nuke connects them: by its stack."""
    stack: list[Node] = []
    named: dict[str, Node] = {}
    nodes: list[Node] = []
    lines = iter(text.splitlines())
    for line in lines:
        if line == "end_group":
            assert next(lines, None) is None
            break
        if push := re.fullmatch(r"push \$(\w+)", line):
            stack.append(named[push[1]])
        elif kept := re.fullmatch(r"set (\w+) \[stack 0\]", line):
            assert kept[1] not in named
            named[kept[1]] = stack[-1]
        else:
            opened = re.fullmatch(r"(\w+) \{", line)
            assert opened, line
            knobs = {}
            while (line := next(lines)) != "}":
                knob = re.fullmatch(r" (\w+) (.+)", line)
                assert knob, line
                knobs[knob[1]] = knob[2]
            node = Node(opened[1], knobs)
            nodes.append(node)
            if node.kind != "Group":
                node.inputs = [stack.pop() for _ in range(int(knobs["inputs"]))]
                stack.append(node)
    else:
        raise AssertionError("the group has no end")
    group, *within = nodes
    assert group.kind == "Group"
    return group, within


def run(nodes: list[Node], backdrop: Image, channels: dict[str, Image], folder: Path) -> Image:
    """What the group's output shows: (height, width, 4), row 0 at the top."""
    seen: dict[int, Image | dict[str, Image]] = {}
    for n, node in enumerate(nodes):
        of = [seen[id(one)] for one in node.inputs]
        seen[id(node)] = _run(node, of, backdrop, channels, folder / str(n))
    return np.asarray(seen[id(nodes[-1])])[::-1]


def _run(
    node: Node, of: list[Image | dict[str, Image]], backdrop: Image, channels: dict[str, Image], at: Path
) -> Image | dict[str, Image]:
    """The picture of a node, row 0 at the bottom as in Nuke."""
    match node.kind:
        case "Input":
            return backdrop[::-1]
        case "Read":
            return {name: values[::-1] for name, values in channels.items()}
        case "Constant":
            width, height = (int(one) for one in node.knobs["format"].strip('"').split()[:2])
            return np.zeros((height, width, 4), np.float32)
        case "Shuffle":
            (held,) = of
            assert isinstance(held, dict)
            planes = [held[f"{node.knobs['in']}.{c}"] for c in "RGB"]
            return np.stack([*planes, np.zeros_like(planes[0])], axis=-1)
        case "BlinkScript":
            return _run_kernel(node.kernel, [np.asarray(one) for one in of], at)
        case "Blur":
            # As Natron documents its twin: the standard deviation is the size over 2.4. Edges are repeated.
            (image,) = (np.asarray(one) for one in of)
            found = re.fullmatch(r"\{\{([^{}]+)\} \{([^{}]+)\}\}", node.knobs["size"])
            assert found
            assert node.knobs["filter"] == "gaussian"
            known = {"input": SimpleNamespace(width=image.shape[1], height=image.shape[0])}
            across, down = (_value(expression, known) / 2.4 for expression in found.groups())
            return np.asarray(gaussian_filter(image, (down, across, 0), mode="nearest"))
        case "STMap":
            source, places = (np.asarray(one) for one in of)
            assert node.knobs["uv"] == "rgb"
            v, u = (places[..., c] * source.shape[1 - c] - 0.5 for c in (1, 0))
            interpolate = {"Impulse": _nearest, "Cubic": _smooth}[node.knobs["filter"]]
            return interpolate(source, v, u)
        case "Expression":
            (image,) = (np.array(one) for one in of)
            y, x = np.mgrid[: image.shape[0], : image.shape[1]]
            known = {c: image[..., n].astype(float) for n, c in enumerate("rgb")} | {"x": x, "y": y}
            for n in range(4):
                if name := node.knobs.get(f"temp_name{n}"):
                    known[name] = _value(node.knobs[f"temp_expr{n}"].strip('"'), known)
            for c in range(3):
                if expression := node.knobs.get(f"expr{c}"):
                    image[..., c] = _value(expression.strip('"'), known)
            return image
        case "MergeExpression":
            below, above = (np.asarray(one) for one in of)
            known = {f"B{c}": below[..., n] for n, c in enumerate("rgb")}
            known |= {f"A{c}": above[..., n] for n, c in enumerate("rgb")}
            planes = [_value(node.knobs[f"expr{c}"].strip('"'), known) for c in range(3)]
            return np.stack([*planes, below[..., 3]], axis=-1).astype(np.float32)
        case "Merge2":
            below, above = (np.asarray(one) for one in of)
            return below * above if node.knobs["operation"] == "multiply" else below + above
        case "ColorMatrix":
            values = [float(one) for one in re.findall(r"[-\d.e]+", node.knobs["matrix"])]
            (image,) = (np.asarray(one) for one in of)
            mixed = image[..., :3] @ np.reshape(values, (3, 3)).T
            return np.concatenate([mixed, image[..., 3:]], axis=-1).astype(np.float32)
        case "Copy":
            image, held = np.array(of[0]), of[1]
            assert isinstance(held, dict)
            image[..., 3] = held["A"]
            return image
        case "Crop" | "Output":
            return of[0]
    raise AssertionError(node.kind)


def _value(expression: str, known: dict[str, Any]) -> Any:
    """The value of an expression of Nuke's; these are also Python."""
    functions = {"max": np.maximum, "min": np.minimum, "clamp": np.clip, "floor": np.floor}
    functions |= {"sqrt": np.sqrt, "pow": np.power}
    return eval(expression, {"__builtins__": {}}, functions | known)


def _nearest(image: Image, y: NDArray[np.floating], x: NDArray[np.floating]) -> Image:
    """The pixels that places lie in, counted from the centre of the first; edges are repeated."""
    rows, columns = (
        np.clip(np.floor(at + 0.5), 0, n - 1) for at, n in zip((y, x), image.shape[:2], strict=True)
    )
    return np.asarray(image[rows.astype(int), columns.astype(int)])


def _smooth(image: Image, y: NDArray[np.floating], x: NDArray[np.floating]) -> Image:
    """Between pixels as Natron's twin of the filter Cubic goes: by ``f^2 (3 - 2 f)`` at a fraction f."""
    near = [(np.floor(at), at - np.floor(at)) for at in (y, x)]
    seen = np.zeros((*y.shape, image.shape[2]))
    for corner in np.ndindex(2, 2):
        share = np.prod(
            [np.abs(1 - i - f * f * (3 - 2 * f)) for i, (_, f) in zip(corner, near, strict=True)], axis=0
        )
        at = (first + i for i, (first, _) in zip(corner, near, strict=True))
        seen += share[..., np.newaxis] * _nearest(image, *at)
    return seen.astype(np.float32)


def _run_kernel(source: str, images: list[Image], at: Path) -> Image:
    """Compile a kernel and run it for every pixel of its first input."""
    (name,) = re.findall(r"^kernel (\w+)", source, re.M)
    inputs = re.findall(r"Image<eRead, \w+, \w+> (\w+);", source)
    assert len(inputs) == len(images)
    at.mkdir()
    height, width = images[0].shape[:2]
    position = "here" if "process(int2" in source else ""
    loads = []
    for image_name, image in zip(inputs, images, strict=True):
        if image.shape[2] == 3:
            image = np.concatenate([image, np.ones((*image.shape[:2], 1))], axis=-1)
        path = at / image_name
        path.write_bytes(np.ascontiguousarray(image, np.float32).tobytes())
        loads.append(f'load(k.{image_name}, "{path}", {image.shape[1]}, {image.shape[0]});')
    program = f"""#include "{SHIM}"
{source}
int main() {{
	{name} k;
	{" ".join(loads)}
	k.dst.bounds = {{0, 0, {width}, {height}}};
	k.dst.pixels.resize({width * height});
	k.define();
	for (here.y = 0; here.y < {height}; here.y++)
		for (here.x = 0; here.x < {width}; here.x++) k.process({position});
	save(k.dst, "{at / "dst"}");
}}
"""
    (at / "kernel.cpp").write_text(program)
    command = ["g++", "-std=c++17", "-O1", "-o", str(at / "kernel"), str(at / "kernel.cpp")]
    compiled = subprocess.run(command, capture_output=True, text=True)
    assert compiled.returncode == 0, compiled.stderr
    subprocess.run([at / "kernel"], check=True, timeout=60)
    return np.frombuffer((at / "dst").read_bytes(), np.float32).reshape(height, width, 4)
