"""Options, markers and fixtures of all tests."""

import atexit
import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

from storage.database.engine import open_engine
from tests.parts import postgres
from tests.parts.s3 import s3, s3_server

EXHAUSTIVE = 3
"""Value of ``--times`` from which on exhaustive tests run too."""
SERVED = ("end_to_end", "browser")
"""Folders whose tests share a service."""
KERNELS = pytest.StashKey["tuple[subprocess.Popen[bytes], str]"]()
COMPILED = "kernels/compiled"
"""Where pytest's cache keeps of which version all kernels are compiled."""
__all__ = ["postgresql", "postgresql_server", "s3", "s3_server"]


def pytest_configure() -> None:
    """Handle SIGINT even where a shell started pytest in the background: its jobs, and all they start, ignore it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Search nothing that is imported for garbage, now or later: pytest alone does it five times at the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        atexit.register(gc.unfreeze)  # libraries that find their own objects at the end call them leaked


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="Run the slow tests too.")
    parser.addoption(
        "--times",
        type=int,
        default=1,
        help=f"How often each fault is injected; {EXHAUSTIVE} or more runs the exhaustive tests, and all others.",
    )


def version_of_kernels() -> str:
    """When a source of the kernels changed last, and which Python compiles them."""
    changed = max(path.stat().st_mtime for path in (Path(__file__).parents[1] / "workflows").rglob("*.py"))
    return f"{changed} {sys.version}"


def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Compile the kernels beside the first tests: in a fresh tree each process would compile them for itself."""
    version = version_of_kernels()
    if config.cache.get(COMPILED, None) == version:
        return
    warm = subprocess.Popen(
        [sys.executable, "-m", "services", "warm"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    config.stash[KERNELS] = warm, version


class OneService(LoadFileScheduling):
    """Gives whole files to a process, and all tests of one service to the same, so that it starts once."""

    def _split_scope(self, nodeid: str) -> str:
        folder = nodeid.split("/")[1]
        return folder if folder in SERVED else super()._split_scope(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> OneService | None:
    """Share services in the default run, which tests each for seconds only; slow tests are spread over processes."""
    return None if config.getoption("--all") else OneService(config, log)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Interrupt what still compiles, with the processes it has started, so that nothing is left of it."""
    if KERNELS in config.stash:
        warm, version = config.stash[KERNELS]
        if warm.poll() is None:
            os.killpg(warm.pid, signal.SIGINT)
        if warm.wait() == 0:
            config.cache.set(COMPILED, version)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests that take long and were not asked for."""
    exhaustive = config.getoption("--times") >= EXHAUSTIVE
    wanted = {"slow": config.getoption("--all") or exhaustive, "exhaustive": exhaustive}
    selected = [
        item for item in items if all(wanted.get(marker.name, True) for marker in item.iter_markers())
    ]
    if len(selected) < len(items):
        config.hook.pytest_deselected(items=list(set(items) - set(selected)))
        items[:] = selected


@pytest.fixture(scope="session")
def times(pytestconfig: pytest.Config) -> int:
    """How often each fault is injected."""
    return int(pytestconfig.getoption("--times"))


@pytest.fixture(scope="session")
def postgresql_server() -> Iterator[postgres.Server]:
    """A PostgreSQL server; skipped where none can be run."""
    with postgres.server() as server, server.database(postgres.TEMPLATE) as url:
        open_engine(url).dispose()
        yield server


@pytest.fixture
def postgresql(postgresql_server: postgres.Server) -> Iterator[str]:
    """The URL of a fresh database that has the tables."""
    with postgresql_server.database(like=postgres.TEMPLATE) as url:
        yield url


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite database with the tables, from which new ones are copied."""
    path = tmp_path_factory.mktemp("sqlite") / "with_tables.db"
    open_engine(f"sqlite:///{path}").dispose()
    return path


@pytest.fixture
def sqlite(tmp_path: Path, sqlite_template: Path) -> str:
    """The URL of a new SQLite database with the tables."""
    path = tmp_path / "ledger.db"
    shutil.copyfile(sqlite_template, path)
    return f"sqlite:///{path}"


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str:
    """The URL of a new database with the tables, of either kind."""
    url: str = request.getfixturevalue(request.param)
    return url
