"""Why a value does not fit a model, in our words: pydantic's name types of Python, and stay English in the app."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import ErrorDetails

from workflows.untrusted.control_characters import CONTROL

REASONS = {
    "missing": "is required",
    "extra_forbidden": "is not a known field",
    "greater_than_equal": "must be at least {ge}",
    "greater_than": "must be more than {gt}",
    "less_than_equal": "must be at most {le}",
    "less_than": "must be less than {lt}",
    "multiple_of": "must be a multiple of {multiple_of}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "union_tag_invalid": "must have one of these in {discriminator}: {expected_tags}",
    "union_tag_not_found": "must have the field {discriminator}",
    "string_too_short": "must have {min_length} or more characters",
    "string_too_long": "must have at most {max_length} characters",
    "too_short": "must have {min_length} or more entries",
    "too_long": "must have at most {max_length} entries",
    "string_pattern_mismatch": "must match {pattern}",
    "json_invalid": "is not JSON ({error})",
    "value_error": "{error}",
}
"""By the type of pydantic's error; the places are of its context."""
TYPES = {
    "int": "must be a whole number",
    "float": "must be a number",
    "finite": "must be a number",
    "string": "must be text",
    "bool": "must be true or false",
    "list": "must be a list",
    "tuple": "must be a list",
    "dict": "must be an object",
    "model": "must be an object",
}
"""By the first word of the type of pydantic's error, for values of another type."""
UNION_TAGS = {"constant", "halftone", "bernoulli", "stripes", "images", "Gamma"}
"""Names that pydantic inserts in an error's location to say which member of a union it tried."""


def field_and_reason(faults: Sequence[ErrorDetails]) -> tuple[str, str]:
    """The field to correct first, and why its value was refused.

    Examples
    --------
    >>> from pydantic import TypeAdapter, ValidationError
    >>> try:
    ...     TypeAdapter(dict[str, list[int]]).validate_python({"sizes": [1, "two"]})
    ... except ValidationError as error:
    ...     field_and_reason(error.errors())
    ('sizes.1', 'must be a whole number')
    """
    # Each member of a union that was tried gives an error; the deepest one is the most specific.
    fault = max(faults, key=lambda fault: len(fault["loc"]))
    names = [str(part) for part in fault["loc"] if part not in UNION_TAGS]
    return ".".join(name for name in names if "[" not in name), reason(fault)


def reason(fault: ErrorDetails) -> str:
    """Why a value was refused, in words that follow its name.

    Examples
    --------
    >>> from pydantic import TypeAdapter, ValidationError
    >>> try:
    ...     TypeAdapter(bool).validate_python("perhaps")
    ... except ValidationError as error:
    ...     reason(error.errors()[0])
    'must be true or false'
    """
    kind = fault["type"]
    if kind in REASONS:
        return REASONS[kind].format(**fault.get("ctx", {}))
    return TYPES.get(kind.partition("_")[0], fault["msg"])


def _without_controls(name: str) -> str:
    if CONTROL.search(name):
        raise ValueError("must have no line breaks or other control characters")
    return name


# PostgreSQL stores no NUL, and the others command terminals.
Name = Annotated[str, Field(max_length=200), AfterValidator(_without_controls)]
"""A name for people."""
