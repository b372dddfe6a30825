"""Live pictures of traced scenes beside the service's composites. Only a kit can film these scenes."""

from pathlib import Path

import pytest
from playwright.sync_api import Page

from tests.benchmarks.compositing.live import backdrops_of, measure, recover
from tests.benchmarks.recovery.kits import load
from tests.end_to_end.conftest import Service

pytestmark = pytest.mark.exhaustive


@pytest.fixture(scope="session")
def kit_and_scenes(pytestconfig: pytest.Config) -> tuple[Path, Path]:
    """A kit and a folder of scenes; without them the test is skipped."""
    if not (paths := pytestconfig.getoption("--scenes")):
        pytest.skip("no scenes are given: --scenes KIT SCENES, as the benchmarks take them")
    return Path(paths[0]), Path(paths[1])


@pytest.mark.timeout(1800)
def test_live_pictures_of_scenes_agree_with_service(
    kit_and_scenes: tuple[Path, Path], desk: Page, service: Service, tmp_path: Path
) -> None:
    kit = load(kit_and_scenes[0])
    mattes = recover(kit, kit_and_scenes[1], False, service.client, tmp_path)
    assert mattes
    for title, matte in mattes.items():
        row, _ = measure(title, matte, backdrops_of(kit), service.http, desk, frames=1)
        assert all(value > 30 for name, value in row.items() if name.endswith(", dB")), row
