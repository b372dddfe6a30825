"""What the light of a backdrop takes in memory: in a process of its own, by its resident peak.

It is stretched, enlarged, turned and made smaller. A small backdrop comes first, so that libraries, kernels and threads
are in the baseline.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from tests.parts.peak import peak
from workflows.composite.backdrops.backdrop import backdrop_of, node_light
from workflows.composite.backdrops.placement import Placement

PLACEMENTS = (
    None,
    Placement(scale=100, angle=30),
    Placement(scale=40, right=0.1),  # made a little coarser, before it is sampled
    Placement(scale=0.1),
)


def of_large_after_small(shape: tuple[int, int, int], dtype: str) -> tuple[int, int]:
    """Bytes of a backdrop, and those by which its light takes more than that of a small one."""
    command = [sys.executable, "-m", __name__, json.dumps([shape, dtype])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    size, grown = map(int, done.stdout.split())
    return size, grown


def _light(pixels: np.ndarray) -> None:
    for placement in PLACEMENTS:
        node_light(backdrop_of(pixels, "srgb"), 80, 60, 2, placement, (1280, 960))


if __name__ == "__main__":
    (high, wide, channels), kind = json.loads(sys.argv[1])
    _light(np.full((300, 400, channels), 100, kind))
    large = np.full((high, wide, channels), 100, kind)
    # Reset the peak: compiling uncached kernels takes more memory than what is measured.
    Path("/proc/self/clear_refs").write_text("5")
    before = peak()
    _light(large)
    print(large.nbytes, peak() - before)
