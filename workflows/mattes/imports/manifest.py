"""Models of the JSON in a matte archive."""

from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from storage.errors import ArchiveError
from workflows.mattes.perspective import corners
from workflows.untrusted.validation import reason

Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item")
Three = Annotated[list[Item], Field(min_length=3, max_length=3)]
Side = Annotated[int, Field(ge=1, le=16384)]
Share = Annotated[float, Field(ge=-100, le=100)]
Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]
BareRho = Annotated[float, Field(ge=1e-4, le=1e4)]
Variance = Annotated[float, Field(ge=0, le=1e6)]
MOST_CONDITION = 1e4
"""Condition of the map from the monitor's colours to the camera's, at most."""
Name = Annotated[str, Field(max_length=64)]
Text = Annotated[str, Field(max_length=256)]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class IntervalGiven(_Strict):
    """See `workflows.recovery.interval.Interval`."""

    contrast: Variance
    read: Variance
    shot: Variance
    share: Variance


class BesideGiven(_Strict):
    """What the frame sees beside the object, see `storage.layout.mattes`."""

    sight: Three[Three[Coefficient]]
    rho: Three[BareRho]

    @field_validator("sight")
    @classmethod
    def _faces_the_monitor(cls, sight: list[list[float]]) -> list[list[float]]:
        corners(np.array(sight))
        return sight


class Attributes(_Strict):
    """The attributes of a matte's zarr group."""

    format: Literal["envmatte-matte/1"]
    height: Annotated[int, Field(ge=1, le=65535)]
    width: Annotated[int, Field(ge=1, le=65535)]
    columns: Side
    rows: Side
    block: int
    monitor: Annotated[list[Side], Field(min_length=2, max_length=2)]
    crosstalk: Three[Three[Share]]
    interval: IntervalGiven | None = None
    beside: BesideGiven | None = None
    options: Annotated[dict[Name, bool | int | float | Text | None], Field(max_length=100)]

    @model_validator(mode="after")
    def _tells_colours_apart(self) -> "Attributes":
        seen = np.array(self.crosstalk) * (self.beside.rho if self.beside else 1)
        if self.beside and np.linalg.cond(seen) > MOST_CONDITION:
            raise ValueError("the camera does not tell the colours of the bare monitor apart")
        return self


class Member(_Strict):
    """An entry in the manifest."""

    size: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Manifest(_Strict):
    """envmatte.json."""

    format: Literal["envmatte-archive/1"]
    matte: dict[str, Any]
    members: dict[str, Any]
    """Each value is a `Member`."""


def valid(model: type[Model], given: Any, entry: str, within: str = "") -> Model:
    """Validate an entry, or a part of it, against a model; raise `ArchiveError` if it does not fit."""
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        field = within + ".".join(str(part) for part in first["loc"])
        raise ArchiveError(
            f"{entry}: {field + ': ' if field else ''}{reason(first)}", entry=entry, field=field
        ) from error
