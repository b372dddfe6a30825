"""Photographs of known patterns by a real camera, and what the methods that any patterns serve make of them.

The service takes such a capture in; all methods get its calibration: noise, exposure, and the glare that it has found.
"""

import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.client import Client
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.benchmarks.field.methods.codes import Stripes
from tests.benchmarks.field.methods.method import Floats, Matte
from tests.benchmarks.field.methods.ours import EngineMatte
from tests.benchmarks.field.methods.rivals import LASSO, NNLS, OMP
from tests.benchmarks.recovery.kits import load, served
from tests.benchmarks.recovery.solvers import Recover
from workflows.images.tone_curves import to_light
from workflows.ingest.light.measured_light import read_light
from workflows.ingest.light.observation import constants_of
from workflows.mattes import tiles
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import fit_photometry
from workflows.recovery.glare import add_glare

SIDE = 4
"""Pixels along a side of the squares that are sampled."""
SERVED: dict[str, dict[str, Any]] = {
    "envmatte, default": {},
    "NN-DGSR": {"method": "nn-dgsr"},
}
"""The options of the service's own recoveries."""
SOLVERS = {"NNLS": NNLS, "lasso": LASSO, "OMP": OMP}
Predict = Callable[[Floats], Floats]
"""Light (rows, columns) of the monitor to values (n,) of pixels."""


def measure(tool: Path, pixels: int) -> Iterator[dict[str, Any]]:
    """Recover each set of photographs by each method.

    Parameters
    ----------
    tool : Path
        A script with a folder `HERE` of captures, ``load`` and ``scored``, as `tests.benchmarks.recovery.real` runs.
    pixels : int
        About how many pixels of each set are scored, and recovered by solvers that take one at a time.
    """
    photographs = load(tool)
    with served(2) as (client, folder):
        for name in sorted(path.name for path in photographs.HERE.iterdir()):
            yield from _measure(photographs, name, client, folder, pixels)


def _measure(
    photographs: ModuleType, name: str, client: Client, folder: Path, pixels: int
) -> Iterator[dict[str, Any]]:
    photo, shown, black, white = photographs.load(name)
    chosen = _squares(black.shape, pixels)
    capture = client.wait(client.upload(photographs.HERE / name / "capture.zip")).answer["capture"]
    frames = len(Stack(Objects((folder / "data" / "store").as_uri()), capture).attributes["patterns"])

    def row(method: str, predict: Predict, seconds: float, pixels: int) -> dict[str, Any]:
        found = photographs.scored(predict, photo.reshape(len(photo), -1)[:, chosen], shown)
        return {
            "camera": "photographs",
            "scene": name,
            "method": method,
            "frames": frames,
            "dB": found["mean"],
            "worst": found["worst"],
            "s / 1,000": seconds / pixels * 1000,
        }

    for method, options in SERVED.items():
        job = client.wait(client.recover(capture, **options)).answer
        with sqlite3.connect(folder / "data" / "envmatte.db") as ledger:
            (seconds,) = ledger.execute(
                "select sum(seconds) from tiles where job = ?", (job["id"],)
            ).fetchone()
        yield row(method, _served(client, job["matte"], chosen), seconds, job["pixels"])
    for method, recover in _methods(folder, capture, chosen):
        start = time.process_time()
        matte = recover()
        yield row(method, _predict(matte), time.process_time() - start, chosen.size)
    start = time.process_time()
    baseline = photographs.baseline(name, black, white)
    seconds = time.process_time() - start
    yield row(
        "one Gaussian along each axis", lambda light: baseline(light).ravel()[chosen], seconds, black.size
    )


def _squares(shape: tuple[int, ...], pixels: int) -> NDArray[np.intp]:
    """Indices of pixels of a frame in squares all over it."""
    y, x = np.divmod(
        np.random.default_rng(0).permutation((shape[0] // SIDE) * (shape[1] // SIDE)), shape[1] // SIDE
    )
    down, across = np.divmod(np.arange(SIDE**2), SIDE)
    squares = slice(max(pixels // SIDE**2, 1))
    return ((SIDE * y[squares, None] + down) * shape[1] + SIDE * x[squares, None] + across).ravel()


def _served(client: Client, matte: str, chosen: NDArray[np.intp]) -> Predict:
    def predict(light: Floats) -> Floats:
        made = client.composite(matte, light.astype(np.float32), transfer="linear")
        values: Floats = np.clip(made[..., :3].mean(axis=2), 0, 1).ravel()[chosen]
        return values

    return predict


def _predict(matte: Matte) -> Predict:
    def predict(light: Floats) -> Floats:
        values: Floats = matte.composite(np.repeat(light.astype(np.float32)[..., None], 3, axis=2)).mean(
            axis=1
        )
        return values

    return predict


def _methods(
    folder: Path, capture: str, chosen: NDArray[np.intp]
) -> Iterator[tuple[str, Callable[[], Matte]]]:
    """The methods that recover in this process, from the light of the chosen pixels."""
    objects = Objects((folder / "data" / "store").as_uri())
    stack = Stack(objects, capture)
    attributes = stack.attributes
    program, monitor = tiles.program_of(objects, capture)
    whole = slice(0, stack.height), slice(0, stack.width)
    every, _ = read_light(stack, whole, program, tiles.gain_of(objects, capture))
    light = every.of_pixels(chosen)
    noise = NoiseModel(**attributes["noise"])
    numbers, sent = constants_of(attributes, program)
    photometry = fit_photometry(light.of_patterns(numbers), to_light(sent, monitor), noise)
    measured = PatternLight.of(light.values[:, program.measured])  # the solvers leave nothing out
    glare = attributes.get("glare")

    def solved(solve: Recover) -> EngineMatte:
        transport = solve(measured, photometry, tiles.sensing_of(objects, capture), noise)
        return EngineMatte(photometry, add_glare(transport, glare) if glare else transport)

    for name, solve in SOLVERS.items():
        yield name, lambda solve=solve: solved(solve)
    shares = (measured.values - photometry.S[:, None]) / np.maximum(photometry.rho, 1e-3)[:, None]
    drawn = list(program.pictures(0, program.count, stack.images()))
    pictures = [drawn[number] for number in program.measured]
    for name, widest in (("rectangles", None), ("one place", 1)):
        yield (
            name,
            lambda widest=widest: Stripes(pictures, widest).recover(shares, photometry.S, photometry.rho),
        )
