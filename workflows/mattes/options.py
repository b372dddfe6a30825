"""The options of recovery jobs: parsed, checked and described.

What a method's own options are, their defaults, ranges and descriptions are declared beside the method, in
`workflows.recovery.lobes.options` and `workflows.recovery.dgsr.options`. The models here are made from that.
"""

from functools import cache
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from storage.errors import OptionError
from workflows.recovery.dgsr.options import DgsrOptions
from workflows.recovery.lobes.options import FAST, FINE, LobesOptions
from workflows.recovery.options import declared_options, make_options

_FAST = {name: value for name, value in FAST._asdict().items() if value != getattr(FINE, name)}


class RecoveryOptions(BaseModel):
    """Options of every recovery job; each method's model adds its own."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    declared: ClassVar[type[LobesOptions | DgsrOptions]]

    method: str
    tile: int | None = Field(
        None,
        ge=16,
        le=1024,
        description="Edge of the square tiles, in pixels, rounded up to whole blocks of the matte. Each tile is one "
        "task; the default is one block. The matte does not depend on it.",
    )
    cut_out: bool = Field(
        False,
        description="Recover the object alone, without the bare monitor and the room around it. Some bare monitor has "
        "to be seen around the object. A capture with a mask is recovered within that, whatever this is.",
    )

    @property
    def of_method(self) -> LobesOptions | DgsrOptions:
        """The method's own options, as its `recover` takes them."""
        return make_options(self.declared, dict(self))


class _LobesQuality(RecoveryOptions):
    quality: Literal["fine", "fast"] = Field(
        "fine",
        description="`fast` takes four fifths of the time and costs 0.3 to 1.8 dB. It changes the defaults: "
        + ", ".join(f"`{name}` {value}" for name, value in _FAST.items())
        + ".",
    )

    @model_validator(mode="before")
    @classmethod
    def _apply_quality(cls, given: Any) -> Any:
        return _FAST | given if isinstance(given, dict) and given.get("quality") == "fast" else given


def _model(
    method: str, declared: type[LobesOptions | DgsrOptions], base: type[RecoveryOptions] = RecoveryOptions
) -> type[RecoveryOptions]:
    """The model of a method's options."""
    fields: dict[str, Any] = {"method": (Literal[method], method)}
    for option in declared_options(declared):
        limits: dict[str, Any] = {"ge": option.range.least, "le": option.range.most} if option.range else {}
        fields[option.name] = option.type, Field(option.default, description=option.description, **limits)
    model: type[RecoveryOptions] = create_model(
        declared.__name__, __base__=base, __doc__=declared.__doc__, **fields
    )
    model.declared = declared
    return model


METHODS = (_model("lobes", LobesOptions, _LobesQuality), _model("nn-dgsr", DgsrOptions))
"""A model for each method; the first is the default."""


def parse_options(given: dict[str, Any]) -> RecoveryOptions:
    """Parse the options of a request.

    Returns
    -------
    RecoveryOptions
        The model of the method that `given` names.

    Raises
    ------
    OptionError
        Names the first option that does not exist, belongs to another method or is out of range.
    """
    name = given.get("method", _name(METHODS[0]))
    method = next((method for method in METHODS if _name(method) == name), None)
    if method is None:
        known = ", ".join(_name(method) for method in METHODS)
        raise OptionError(f"option 'method': must be one of {known}", field="method")
    try:
        return method.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        option = str(first["loc"][0])
        raise OptionError(_explain(method, option), field=option) from error


def describe_options() -> list[dict[str, Any]]:
    """Describe every option: name, method, type, default, range or values, and what it does.

    Options of every method come first; their `method` is None.
    """
    summaries = " ".join(f"`{_name(method)}`: {method.__doc__}" for method in METHODS)
    choice = {
        "name": "method",
        "method": None,
        "type": "string",
        "default": _name(METHODS[0]),
        "values": [_name(method) for method in METHODS],
        "minimum": None,
        "maximum": None,
        "description": f"How T is recovered. {summaries}",
    }
    common = [name for name in RecoveryOptions.model_fields if name != "method"]
    return [
        choice,
        *(_describe(METHODS[0], name) | {"method": None} for name in common),
        *(_describe(method, name) for method in METHODS for name in _own(method)),
    ]


def _name(method: type[RecoveryOptions]) -> str:
    return str(method.model_fields["method"].default)


def _own(method: type[RecoveryOptions]) -> list[str]:
    """The options that only some methods have."""
    return [name for name in method.model_fields if name not in RecoveryOptions.model_fields]


@cache
def _schemas(method: type[RecoveryOptions]) -> dict[str, Any]:
    """The JSON schema of each option of a method."""
    schemas: dict[str, Any] = method.model_json_schema()["properties"]
    return schemas


def _describe(method: type[RecoveryOptions], name: str) -> dict[str, Any]:
    schema = _schemas(method)[name]
    # an option that may be null has two schemas, one of them null's
    value = next(value for value in schema.get("anyOf", [schema]) if value["type"] != "null")
    return {
        "name": name,
        "method": _name(method),
        "type": value["type"],
        "default": schema["default"],
        "values": value.get("enum"),
        "minimum": value.get("minimum"),
        "maximum": value.get("maximum"),
        "description": schema["description"],
    }


def _explain(method: type[RecoveryOptions], name: str) -> str:
    """Why the method's model refused an option."""
    if name in method.model_fields:
        option = _describe(method, name)
        if option["values"]:
            return f"option {name!r}: must be one of {', '.join(option['values'])}"
        if option["type"] == "boolean":
            return f"option {name!r}: must be true or false"
        whole = "a whole number " if option["type"] == "integer" else ""
        return f"option {name!r}: must be {whole}between {option['minimum']:g} and {option['maximum']:g}"
    owners = [_name(other) for other in METHODS if name in other.model_fields]
    if owners:
        return f"option {name!r} belongs to the method {' and '.join(owners)}, not to {_name(method)}"
    known = ", ".join(method.model_fields)
    return f"there is no option {name!r}; the options of {_name(method)} are {known}"
