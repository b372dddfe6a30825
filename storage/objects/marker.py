"""The object by which a store is recognised: a folder that is not mounted would pass for an empty store."""

from storage.errors import WrongStore
from storage.objects.store import Objects

PATH = "installation"
LONGEST = 64
"""Bytes of an id, at most."""


def read(objects: Objects) -> str | None:
    """The id of the installation that a store belongs to; None for one that has not been marked.

    Raises
    ------
    StoreUnavailable
    """
    try:
        return objects.read_raw(PATH, LONGEST).decode(errors="replace")
    except FileNotFoundError:
        return None


def write(objects: Objects, installation: str) -> None:
    """Mark a store."""
    objects.write_raw(PATH, [installation.encode()])


def require_mounted(objects: Objects, machine: str = "this machine") -> None:
    """Check that a folder is still that of the installation, if that is known: a share may be unmounted at any time.

    A bucket is not asked: one that is away says so.

    Raises
    ------
    WrongStore
    """
    if objects.installation is not None and objects.url.startswith("file:"):
        require(objects, objects.installation, machine)


def require(objects: Objects, installation: str, machine: str = "this machine") -> None:
    """Check that a store belongs to an installation.

    Parameters
    ----------
    machine : str
        What the error calls the machine that this runs on.

    Raises
    ------
    WrongStore
        If it does not, as far as this machine can see.
    StoreUnavailable
    """
    if read(objects) != installation:
        raise wrong_store(machine)


def wrong_store(machine: str = "this machine") -> WrongStore:
    """The error for a store that is not that of the installation, as far as a machine can see."""
    return WrongStore(
        f"{machine} does not see the store of this installation: its folder may not be mounted there, or its "
        f"bucket is another one. If it is the right store, copy the object `{PATH}` of the former one into it"
    )
