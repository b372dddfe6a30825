"""The process that workers are forked from, with what they need already imported."""

import os
import signal
import sys
import tempfile
from multiprocessing import forkserver, popen_forkserver, resource_tracker

import dask
from distributed.utils import get_mp_context

from storage.errors import Unavailable

PRELOAD = "services.cluster.worker_preload"
"""What a worker imports before it takes work."""
START = 60
"""Seconds that a worker may take to start on a busy machine."""


def start_forkserver(*modules: str) -> None:
    """Start the fork server of this process, which imports some modules for its children.

    Otherwise every worker would import them itself: two seconds, and memory of its own. Call `configure_dask` first.

    Raises
    ------
    Unavailable
        If processes can't share locks here, which dask needs, or the folder of temporary files takes no sockets.
    """
    try:
        os.chdir(os.getcwd())
    except OSError:
        # It was deleted, or this user may not enter it, as after `sudo -u`; workers want to go there.
        os.chdir("/")
    for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items():
        os.environ[name] = str(value)  # as nannies do, but before libraries that read it are loaded
    # Workers run the code of this process. Otherwise Python would look in the working directory first, where a clone or
    # anyone's folder may have a `services`. Both stay set, because a fork server that dies is started again.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ["PYTHONPATH"] = os.pathsep.join(map(os.path.abspath, sys.path))
    try:
        get_mp_context().Lock()
    except OSError as error:
        raise Unavailable(
            f"processes can't share locks here: {error.strerror}. Mount a tmpfs that this user may write to on /dev/shm"
        ) from error
    get_mp_context().set_forkserver_preload([*modules])  # replaces what distributed has set
    popen_forkserver.Popen.terminate = popen_forkserver.Popen.kill  # type: ignore[method-assign]  # SIGTERM is blocked
    try:
        ensure_running()
    except OSError as error:
        raise Unavailable(
            f"workers can't be started by a socket in {tempfile.gettempdir()}: {error}. Set TMPDIR to a folder with a "
            "shorter path, such as /tmp"
        ) from error


def ensure_running() -> None:
    """Start the fork server again if it has died, and the resource tracker too.

    A terminal sends Ctrl-C to all processes of a command, and systemd or SLURM SIGTERM to all of a service. It is for
    the one that started these, which ends them in order: the fork server and all workers inherit that both are blocked,
    from their first moment on.
    """
    resource_tracker.ensure_running()  # it unblocks the signals where it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
