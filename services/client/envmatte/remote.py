"""A matte of a service, read over HTTP block by block."""

from typing import Any

from numpy.typing import NDArray

from services.client import Client
from storage.errors import Corrupt
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from workflows.mattes.imports.checks import faults
from workflows.recovery.pyramid import Pyramid


class RemoteMatte:
    """A matte of a service. It reads like `storage.layout.mattes.Matte`, and checks what it reads.

    Parameters
    ----------
    url : str
        Of the service.
    id : str
        Of the matte.
    key : str, optional
        API key.

    Raises
    ------
    ServiceError
        If the service refuses, or does not answer.
    ValueError
        If the matte is not ready.
    """

    def __init__(self, url: str, id: str, key: str | None) -> None:
        self._place = url, id, key
        with Client(url, key) as client:
            state = client.matte(id).state
        if state != "ready":
            raise ValueError(f"matte {id} is {state}: open it once it is ready")
        self._matte = Matte(Objects(f"{url}/v1", key), f"{id}/zarr")
        self.attributes: dict[str, Any] = self._matte.attributes
        self.columns, self.rows = self._matte.columns, self._matte.rows

    def __reduce__(self) -> tuple[object, ...]:
        """In another process it is opened again."""
        return type(self), self._place

    def chunk(self, name: str, row: int, column: int) -> NDArray[Any]:
        """The values of a block in one of the frame-shaped arrays; raises `Corrupt` if they are damaged."""
        return self._matte.chunk(name, row, column)

    def read(self, row: int, column: int) -> Block:
        """A block; raises `Corrupt` if something of it is damaged."""
        block = self._matte.read(row, column)
        # Kernels trust what they are given, as far as to the addresses that they read.
        for name, what in faults(block, Pyramid.over(self.columns, self.rows).nodes):
            raise Corrupt(f"block {row}.{column} of matte {self._place[1]}: {name}: {what}")
        return block
