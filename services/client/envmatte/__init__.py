"""Mattes as xarray Datasets, for scripts and notebooks::

    import envmatte

    glass = envmatte.open("matte.zip")  # what `envmatte export` wrote; or the URL of a matte of a service
    glass.rho.sel(channel="R").plot()
    glass.isel(x=40, y=30).compute()

Nothing is read but what is asked for: chunks are the blocks of the matte. `workflows.mattes.dataset` says what the
variables are.
"""

# The only folder whose import name is not its path: scripts import the name that people install. Its modules import
# each other relatively, for an installed package has no services.envmatte.

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from xarray import Dataset

__all__ = ["open"]
_MATTE = re.compile(r"((?i:https?)://.+?)/(?:v1/mattes|#/mattes)/([\w-]+)")
"""The URL of a matte in the API, or in the app."""


def open(matte: str | Path | BinaryIO, *, lobes: int = 4, key: str | None = None) -> "Dataset":
    """Open a matte. Arrays are read when they are computed, block by block.

    Parameters
    ----------
    matte : str, Path or BinaryIO
        Its archive, as a file, or an open file that is seekable; or its URL,
        ``http://HOST:PORT/v1/mattes/ID``.
    lobes : int
        Of a pixel, 1 to 8, the heaviest first; more are merged into these.
    key : str, optional
        API key of the service; by default ENVMATTE_KEY.

    Raises
    ------
    ImportError
        If xarray is not installed.
    TypeError
        If `lobes` is not a whole number.
    ValueError
        If the URL is not that of a matte, the matte is not ready, or `lobes` is out of range.
    storage.errors.ArchiveError
        If the file is not the archive of a matte, or damaged.
    services.client.ServiceError
        If the service refuses, or does not answer.
    """
    try:
        from workflows.mattes.dataset import Source, dataset_of
    except ModuleNotFoundError as error:
        if error.name != "xarray":
            raise
        raise ImportError("envmatte.open needs xarray: pip install 'envmatte[xarray]'") from error
    from workflows.mattes.imports.archived import ArchivedMatte

    from .remote import RemoteMatte

    source: Source
    if isinstance(matte, str) and re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", matte):
        found = _MATTE.match(matte)
        if not found:
            raise ValueError(f"{matte} is not the URL of a matte: give it as http://HOST:PORT/v1/mattes/ID")
        url, id = found.groups()
        source = RemoteMatte(url, id, key or os.environ.get("ENVMATTE_KEY"))
    else:
        source = ArchivedMatte(Path(matte) if isinstance(matte, str) else matte)
    return dataset_of(source, lobes)
