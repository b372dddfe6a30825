"""The engine `envmatte` of xarray: ``xarray.open_dataset("matte.zip", engine="envmatte")``."""

from collections.abc import Iterable
from typing import Any

import xarray as xr
from xarray.backends import BackendEntrypoint

from . import open


class Engine(BackendEntrypoint):
    """Opens what `envmatte.open` opens."""

    description = "Mattes of envmatte, as archives or URLs of a service"

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        lobes: int = 4,
        key: str | None = None,
    ) -> xr.Dataset:
        """Open a matte, see `envmatte.open`."""
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return open(filename_or_obj, lobes=lobes, key=key).drop_vars(dropped, errors="ignore")
