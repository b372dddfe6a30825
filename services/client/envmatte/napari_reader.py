"""The reader of napari: a matte's archive opens as the layers S, rho, alpha and confidence."""

import zipfile
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from . import open

LayerData = tuple[Any, dict[str, Any], str]
_SHOWN: dict[str, dict[str, Any]] = {
    "S": {"rgb": True},
    "rho": {"rgb": True},
    "alpha": {"contrast_limits": (0, 1), "colormap": "gray"},
    "confidence": {"contrast_limits": (0, 1), "colormap": "viridis"},
}
"""Of each layer, how napari is to show it."""


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[LayerData]] | None:
    """What reads a file, or None if it is not the archive of a matte."""
    if not isinstance(path, str):
        return None
    with suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as file:
        if "envmatte.json" in file.namelist():
            return _read
    return None


def _read(path: str | list[str]) -> list[LayerData]:
    assert isinstance(path, str)
    matte = open(path)
    return [
        (matte[name].data, {"name": name, "visible": name == "rho", **more}, "image")
        for name, more in _SHOWN.items()
    ]
