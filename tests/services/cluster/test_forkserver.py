"""The process that workers are forked from: what it imports, what reaches it, and where it can't start."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.parts.processes import running
from tests.parts.waiting import until
from tests.services.cluster.clusters import children, workers

INSTALLED = "import sys; del sys.path[0]; from services.__main__ import run; run()"
"""Runs the command as its script does, for which the working directory is not on the path."""
ROOT = Path(__file__).parents[3]
UNWRITABLE = 'mount -t tmpfs -o ro none /dev/shm && exec "$@"'


def test_machine_without_shared_memory_is_named(tmp_path: Path) -> None:
    alone = ["unshare", "--map-root-user", "--mount", "sh", "-c", UNWRITABLE, "sh"]
    tried = subprocess.run([*alone, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"no file system can be mounted for a process here: {tried.stderr.strip()}")
    serve = [sys.executable, "-m", "services", "serve", "--data", str(tmp_path / "data"), "--port", "0"]
    served = subprocess.run([*alone, *serve], capture_output=True, text=True, timeout=120)
    assert served.returncode == 1
    assert served.stderr.splitlines()[-1] == (
        "Error: processes can't share locks here: Read-only file system. Mount a tmpfs that this user may write to on "
        "/dev/shm"
    )
    assert "Traceback" not in served.stderr


def test_folder_whose_path_is_too_long_for_sockets_is_named(tmp_path: Path) -> None:
    long = tmp_path / ("long" * 25)
    long.mkdir()
    serve = [sys.executable, "-m", "services", "serve", "--data", str(tmp_path / "data"), "--port", "0"]
    environment = os.environ | {"TMPDIR": str(long)}
    served = subprocess.run(serve, env=environment, capture_output=True, text=True, timeout=120)
    assert served.returncode == 1
    assert served.stderr.splitlines()[-1] == (
        f"Error: workers can't be started by a socket in {long}: AF_UNIX path too long. Set TMPDIR to a folder with a "
        "shorter path, such as /tmp"
    )


def test_workers_do_not_run_the_code_of_the_working_directory(tmp_path: Path) -> None:
    (tmp_path / "services").mkdir()
    (tmp_path / "services" / "__init__.py").write_text("open('imported', 'w').close(); raise SystemExit")
    serve = [sys.executable, "-c", INSTALLED, "serve", "--port", "0", "--workers", "1"]
    with running(serve, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}) as process:
        until(lambda: workers(process) or (tmp_path / "imported").exists())
        assert not (tmp_path / "imported").exists()
        process.terminate()
        process.wait(60)


def test_the_working_directory_may_be_gone(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    options = ["--data", str(tmp_path / "data"), "--port", "0", "--workers", "1"]
    serve = [sys.executable, "-c", f"import os; os.rmdir({str(folder)!r}); {INSTALLED}", "serve", *options]
    with running(serve, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}) as process:
        assert process.stdout is not None
        assert " at http" in process.stdout.readline()
        process.terminate()
        process.wait(60)


def test_ctrl_c_while_the_cluster_starts_ends_it_without_tracebacks(tmp_path: Path) -> None:
    options = ["--data", str(tmp_path), "--port", "0", "--workers", "1"]
    with running([sys.executable, "-m", "services", "serve", *options], start_new_session=True) as process:
        until((tmp_path / "scratch").exists, by=process)  # the cluster makes it
        os.killpg(process.pid, signal.SIGINT)
        _, log = process.communicate(timeout=120)
    assert (process.returncode, "Interrupted." in log, "Traceback" in log) == (130, True, False), log


@pytest.mark.parametrize("replaced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ctrl_c_in_a_terminal_ends_a_service_without_tracebacks(tmp_path: Path, replaced: bool) -> None:
    options = ["--data", str(tmp_path), "--port", "0", "--workers", "1"]
    serve = [sys.executable, "-m", "services", "serve", *options]
    with running(serve, start_new_session=True) as process:
        assert process.stdout is not None
        assert " at http" in process.stdout.readline()
        (worker,) = workers(process)
        if replaced:
            worker.parent().kill()
            until(lambda: {*workers(process)} - {worker})
        os.killpg(process.pid, signal.SIGINT)
        _, log = process.communicate(timeout=120)
    assert (process.returncode, "Interrupted." in log, "Traceback" in log) == (130, True, False), log


def test_sigterm_to_all_processes_of_a_service_is_for_the_one_that_started_them(tmp_path: Path) -> None:
    options = ["--data", str(tmp_path), "--port", "0", "--workers", "1"]
    serve = [sys.executable, "-m", "services", "serve", *options]
    with running(serve, start_new_session=True) as process:
        assert process.stdout is not None
        assert " at http" in process.stdout.readline()
        family = [one for one in children(process) if "decoder_server" not in str(one.cmdline())]
        for one in family:
            one.terminate()
        _, alive = psutil.wait_procs(family, timeout=1)
        assert set(alive) == set(family)
        process.terminate()
        _, log = process.communicate(timeout=120)
    assert (process.returncode, "Restarting worker" in log, "Traceback" in log) == (0, False, False), log


def test_a_process_of_the_fork_server_can_be_terminated() -> None:
    code = "import time; from services.cluster.dask_config import configure_dask; configure_dask()\n"
    code += "from services.cluster.forkserver import get_mp_context, start_forkserver; start_forkserver()\n"
    code += "process = get_mp_context().Process(target=time.sleep, args=(600,)); process.start()\n"
    code += "process.terminate(); process.join(60); print(process.exitcode)"
    with running([sys.executable, "-c", code]) as process:
        out, log = process.communicate(timeout=120)
    assert out == f"{-signal.SIGKILL}\n", log
