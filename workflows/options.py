"""The options of recovery: the one place that says what there is, and in which range."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from storage.errors import OptionError


class RecoveryOptions(BaseModel):
    """What a recovery job may be asked for."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Literal["pyramid", "nn-dgsr"] = Field(
        "pyramid",
        description="How T is recovered: `pyramid`, level by level through every band of a program whose grids nest, "
        "one T for the channels together; `nn-dgsr`, the hierarchical method of the paper (Sect. 4.2 and 5.1), "
        "from grid to finer grid, the channels apart.",
    )
    tile: int | None = Field(
        None,
        ge=16,
        le=1024,
        description="Edge of the squares that the frame is cut into, one task each, in pixels, rounded up to whole "
        "blocks of the matte. Left out: one block. The matte does not depend on it.",
    )


def parse_options(given: dict[str, Any]) -> RecoveryOptions:
    """Options as they are sent.

    Raises
    ------
    OptionError
        Naming the first option that does not exist or is out of range.
    """
    try:
        return RecoveryOptions.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        name = str(first["loc"][0])
        if first["type"] == "extra_forbidden":
            known = ", ".join(RecoveryOptions.model_fields)
            raise OptionError(f"there is no option {name!r}; the options are {known}", field=name) from error
        raise OptionError(f"option {name!r}: {first['msg']}", field=name) from error


def describe_options() -> list[dict[str, Any]]:
    """Every option: name, type, default, range, what it does."""
    described = []
    for name, schema in RecoveryOptions.model_json_schema()["properties"].items():
        kinds = [kind for kind in schema.get("anyOf", [schema]) if kind.get("type") != "null"]
        kind = kinds[0]
        described.append(
            {
                "name": name,
                "type": kind["type"],
                "default": schema.get("default"),
                "values": kind.get("enum"),
                "minimum": kind.get("minimum"),
                "maximum": kind.get("maximum"),
                "description": schema["description"],
            }
        )
    return described
