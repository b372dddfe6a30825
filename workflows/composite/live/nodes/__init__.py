"""A matte's lookups as an EXR, and files that make nodes of compositing software which draw the glass from it.

`FILES` has what writes each file, by its name, with a number of lookups of a pixel; all but the EXR also for a `plate`.
"""

from collections.abc import Callable

from workflows.composite.live.nodes.blender import write_blender
from workflows.composite.live.nodes.exr import write_lookups
from workflows.composite.live.nodes.nuke import write_nuke
from workflows.composite.live.nodes.nuke_stmap import write_nuke_stmap

FILES: dict[str, Callable[..., None]] = {
    "lookups.exr": write_lookups,
    "blender.py": write_blender,
    "nuke.nk": write_nuke,
    "nuke_stmap.nk": write_nuke_stmap,
}
