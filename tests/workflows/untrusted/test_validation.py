"""Refused values are explained in our own words, never in those of pydantic."""

from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from workflows.untrusted.validation import reason


class Screen(BaseModel):
    kind: Literal["screen"] = "screen"


class Wall(BaseModel):
    kind: Literal["wall"]


class Asked(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str = Field("", min_length=1, max_length=5, pattern="^[a-z]*$")
    width: int = Field(1, ge=1, le=16384)
    rate: float = Field(1, gt=0, lt=120, allow_inf_nan=False)
    level: float = Field(0, multiple_of=0.25)
    colour: Literal["grey", "rgb"] = "grey"
    parts: tuple[int, ...] = Field((1,), min_length=1, max_length=2)
    names: dict[str, str] = {}
    aside: list[int] = []
    border: bool = False
    screen: Screen = Screen()
    shown: Annotated[Screen | Wall, Field(discriminator="kind")] = Screen()

    @field_validator("name")
    @classmethod
    def _is_free(cls, name: str) -> str:
        if name == "taken":
            raise ValueError("another one has this name")
        return name


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"name": ""}, "must have 1 or more characters"),
        ({"name": "abcdef"}, "must have at most 5 characters"),
        ({"name": "ABC"}, "must match ^[a-z]*$"),
        ({"name": 3}, "must be text"),
        ({"name": "taken"}, "another one has this name"),
        ({"width": 0}, "must be at least 1"),
        ({"width": 16385}, "must be at most 16384"),
        ({"width": 1.5}, "must be a whole number"),
        ({"width": "wide"}, "must be a whole number"),
        ({"width": None}, "must be a whole number"),
        ({"width": 10**40}, "must be at most 16384"),
        ({"rate": 0}, "must be more than 0.0"),
        ({"rate": 120}, "must be less than 120.0"),
        ({"rate": "fast"}, "must be a number"),
        ({"rate": float("nan")}, "must be a number"),
        ({"level": 0.3}, "must be a multiple of 0.25"),
        ({"colour": "red"}, "must be 'grey' or 'rgb'"),
        ({"parts": ()}, "must have 1 or more entries"),
        ({"parts": (1, 2, 3)}, "must have at most 2 entries"),
        ({"parts": 1}, "must be a list"),
        ({"names": 1}, "must be an object"),
        ({"aside": 1}, "must be a list"),
        ({"border": "perhaps"}, "must be true or false"),
        ({"screen": 1}, "must be an object"),
        ({"shown": {"kind": "floor"}}, "must have one of these in 'kind': 'screen', 'wall'"),
        ({"shown": {}}, "must have the field 'kind'"),
        ({"other": 1}, "is not a known field"),
    ],
)
def test_value_is_refused_in_our_words(given: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Asked.model_validate(given)
    assert reason(caught.value.errors()[0]) == why


def test_text_that_is_not_json_is_refused_in_our_words() -> None:
    with pytest.raises(ValidationError) as caught:
        Asked.model_validate_json("{")
    assert reason(caught.value.errors()[0]).startswith("is not JSON (")
