"""A cluster for faults, and the matte it makes without them."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.end_to_end.conftest import BANDS
from tests.parts.captures import nested_program
from tests.parts.rig import Rig, Row
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--table", type=Path, help="A file for the table of faults, as JSON.")


@pytest.fixture(scope="session")
def fewer_times(times: int) -> int:
    """How often faults that take half a minute are injected."""
    return max(1, times // 2)


@pytest.fixture(scope="session")
def table(pytestconfig: pytest.Config) -> Iterator[list[Row]]:
    """The rows of the table of faults, printed at the end and written with ``--table``."""
    rows: list[Row] = []
    yield rows
    print(f"\n{'fault':<34}{'injected':>9}{'lost':>6}{'differing':>11}{'median s':>10}{'longest s':>11}")
    for row in (row.as_dict() for row in rows):
        print(
            f"{row['fault']:<34}{row['injected']:>9}{row['lost']:>6}{row['differing']:>11}"
            f"{row['median'] or '-':>10}{row['longest'] or '-':>11}"
        )
    if path := pytestconfig.getoption("--table"):
        path.write_text(json.dumps([row.as_dict() for row in rows], indent=2))


@pytest.fixture(scope="session")
def capture_archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of a glass ball, of 60 tiles."""
    path = tmp_path_factory.mktemp("capture") / "ball.zip"
    write_capture(glass_ball.glass_ball(160, 96, rays=9), nested_program(bands=BANDS, levels=5), path)
    return path


@pytest.fixture(scope="session")
def archive_bytes(capture_archive: Path) -> bytes:
    return capture_archive.read_bytes()


@dataclass
class Prepared:
    """A rig, a capture in it, and the files of its matte without faults."""

    rig: Rig
    capture: str
    files: dict[str, str]

    def disturb(self, fault: str, act: Callable[[], object], times: int) -> Row:
        """Inject a fault at random moments of jobs; returns what became of them."""
        return self.rig.disturb(fault, act, self.capture, self.files, times)

    def check_continues(self, job: str, matte: str) -> None:
        """Check that a job succeeds with the expected matte and waits for nothing."""
        assert self.rig.ended(job)["state"] == "succeeded"
        assert self.rig.job(job)["waits_for"] is None
        assert self.rig.files(matte) == self.files


def check(table: list[Row], row: Row) -> None:
    """Add a row to the table; check that no job was lost and every matte is the same to the byte."""
    table.append(row)
    assert (row.lost, row.differing) == (0, 0), row


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory, capture_archive: Path) -> Iterator[Prepared]:
    with Rig(tmp_path_factory.mktemp("rig")) as rig:
        yield prepare(rig, capture_archive)


def prepare(rig: Rig, capture_archive: Path) -> Prepared:
    """Ingest a capture in a rig and recover it once."""
    uploaded = rig.ask(
        "POST",
        "/v1/captures",
        content=capture_archive.read_bytes(),
        headers={"Content-Type": "application/zip"},
    ).json()
    assert rig.ended(uploaded["job"])["state"] == "succeeded"
    found = rig.ended(rig.recover(uploaded["id"])["id"])
    assert found["state"] == "succeeded"
    return Prepared(rig, uploaded["id"], rig.files(found["matte"]))
