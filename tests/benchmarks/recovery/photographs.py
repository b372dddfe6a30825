"""Counts the pixels of photographs by real cameras that lie within the intervals of composites.

    python -m tests.benchmarks.recovery.photographs TOOL

TOOL is a script that `tests.benchmarks.recovery.real` runs: it has a folder `HERE` of captures, and `load`, photographs
of each that are not in the capture, and what was shown for them. Prints the share of all their pixels within the 90 %
interval, the noise of a photograph counted, and that of the photograph with the least.
"""

import argparse
from pathlib import Path
from types import ModuleType

import numpy as np

from services.client import Client
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.benchmarks.recovery.kits import load, served, show
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.interval import QUANTILE


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tool", type=Path)
    tool = load(parser.parse_args().tool)
    with served(2) as (client, folder):
        for name in sorted(path.name for path in tool.HERE.iterdir()):
            held = measure(tool, name, client, folder)
            show({"name": name, "held": round(float(np.mean(held)), 3), "held_least": round(min(held), 3)})


def measure(tool: ModuleType, name: str, client: Client, folder: Path) -> list[float]:
    """The share of the pixels of each photograph of a scene that lie within the interval."""
    photo, shown, *_ = tool.load(name)
    capture = client.wait(client.upload(tool.HERE / name / "capture.zip")).answer["capture"]
    matte = client.wait(client.recover(capture)).answer["matte"]
    noise = NoiseModel(**Stack(Objects((folder / "data" / "store").as_uri()), capture).attributes["noise"])

    def composite(light: np.ndarray, interval: bool = False) -> np.ndarray:
        picture = client.composite(matte, light.astype(np.float32), transfer="linear", interval=interval)
        return np.asarray(picture[..., :3]).mean(axis=2)

    exponent = tool.scored(composite, photo, shown)["exponent"]  # of the projector's curve
    held = []
    for picture, light in zip(photo, shown, strict=True):
        expected = composite(light**exponent)
        half = np.hypot(
            composite(light**exponent, interval=True), QUANTILE * np.sqrt(noise.variance(expected))
        )
        held.append(float(np.mean(np.abs(expected - picture) <= half)))
    return held


if __name__ == "__main__":
    main()
