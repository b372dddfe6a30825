"""All methods of the benchmark, by family."""

from collections.abc import Callable
from functools import partial

from tests.benchmarks.field.methods.codes import GrayCode, Zongker
from tests.benchmarks.field.methods.compressive import CompressiveDual, CompressiveTransport, PseudoInverse
from tests.benchmarks.field.methods.frequency import CompressedFrequencies, Frequencies
from tests.benchmarks.field.methods.gaussians import OneFrame, Swept
from tests.benchmarks.field.methods.method import Method
from tests.benchmarks.field.methods.ours import Engine
from tests.benchmarks.field.methods.wavelets import WaveletNoise, Wavelets
from tests.benchmarks.recovery.solvers import lasso, least_squares, pursuit, rival
from workflows.recovery.dgsr import recover as dgsr

NNLS, LASSO, OMP = (rival(solve, "hierarchical") for solve in (least_squares, lasso, pursuit))


def grids(frames: int) -> dict[tuple[int, int], int]:
    """Patterns on grids down to the monitor's pixels, for as many frames with the grey levels."""
    middle = (frames - 32) // 4
    return {(16, 12): 24, (64, 48): middle, (256, 192): frames - 32 - middle}


METHODS: list[Callable[[], Method]] = [
    *(partial(Engine, f"envmatte, {name}", name) for name in ("sketch", "quick", "default")),
    *(partial(Engine, f"envmatte, {name} as filmed", name, filmed=True) for name in ("sketch", "quick")),
    partial(Engine, "envmatte, three grids", grids(282)),
    *(partial(Engine, f"NN-DGSR, {frames} frames", grids(frames), dgsr.recover) for frames in (61, 140, 282)),
    partial(Engine, "NN-DGSR, the paper's grids", {(16, 12): 24, (128, 96): 250}, dgsr.recover),
    *(partial(Engine, f"NNLS, {frames} frames", grids(frames), NNLS) for frames in (61, 140, 282)),
    *(partial(Engine, f"lasso, {frames} frames", grids(frames), LASSO) for frames in (140, 282)),
    partial(Engine, "OMP, 282 frames", grids(282), OMP),
    GrayCode,
    Zongker,
    Swept,
    OneFrame,
    Wavelets,
    WaveletNoise,
    Frequencies,
    CompressedFrequencies,
    PseudoInverse,
    CompressiveDual,
    CompressiveTransport,
]
