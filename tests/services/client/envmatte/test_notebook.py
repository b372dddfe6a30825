"""The notebook: its cells run, its composite is the service's, and it is kept with pictures."""

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from storage.layout.matte_archive import Archive
from storage.objects.store import Objects
from tests.workflows.composite.live.nodes.drawing import backdrops, psnr, recovered
from workflows.composite import composite

NOTEBOOK = Path(__file__).parents[4] / "services/client/envmatte/glass.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]


def test_it_is_kept_with_its_pictures() -> None:
    assert NOTEBOOK.stat().st_size < 500_000
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert sum("image/png" in output["data"] for output in outputs) == 3
    assert {output["output_type"] for output in outputs} == {"execute_result", "display_data"}  # no warnings
    assert not any(folder in NOTEBOOK.read_text() for folder in ("/home", "/root", "/tmp"))


def measure_lobes(objects: Objects, glass: str) -> dict[str, float]:
    """Run the cells in this folder, and measure their composite of a traced glass against the service's, in dB."""
    matte = recovered(objects, glass)
    Path("matte.zip").write_bytes(b"".join(Archive(objects, glass)))
    names: dict[str, Any] = {}
    with mpl.rc_context({"backend": "agg"}):
        for cell in CELLS:
            if cell["cell_type"] == "code":
                exec("".join(cell["source"]), names)
        names["plt"].close("all")
    found = {}
    for kind, backdrop in backdrops().items():
        expected = composite(matte, backdrop)
        seen = names["composite"](names["glass"].compute(), backdrop).to_numpy()
        found[kind] = psnr(seen, expected, np.asarray(expected[..., 3] > 0))
    return found


@pytest.mark.slow
def test_its_composite_is_that_of_the_service(
    objects: Objects, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = measure_lobes(objects, "lens")
    # Lobes are four Gaussians of a pixel: exact before a ramp, close before a photo.
    assert found["ramp"] > 80
    assert found["photo"] > 36
