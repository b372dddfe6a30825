"""The options of recovery: parsed, refused by name, and described."""

from typing import Any

import pytest

from storage.errors import OptionError
from workflows.options import RecoveryOptions, describe_options, parse_options


def test_nothing_asked_for_is_the_defaults() -> None:
    assert parse_options({}) == RecoveryOptions(method="pyramid", tile=None)
    assert parse_options({"method": "nn-dgsr", "tile": 64}) == RecoveryOptions(method="nn-dgsr", tile=64)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"tile": 15}, "tile"),
        ({"tile": 1025}, "tile"),
        ({"tile": "many"}, "tile"),
        ({"tile": [16]}, "tile"),
        ({"method": "magic"}, "method"),
        ({"method": None}, "method"),
        ({"tyle": 64}, "tyle"),
        ({"": 1}, ""),
    ],
)
def test_a_refusal_names_the_option(given: dict[str, Any], field: str) -> None:
    with pytest.raises(OptionError) as caught:
        parse_options(given)
    assert caught.value.fields == {"field": field}
    assert repr(field) in caught.value.detail


def test_an_unknown_option_is_told_those_there_are() -> None:
    with pytest.raises(OptionError, match=", ".join(RecoveryOptions.model_fields)):
        parse_options({"tyle": 64})


def test_every_option_is_described_as_it_is_parsed() -> None:
    described = {option["name"]: option for option in describe_options()}
    assert set(described) == set(RecoveryOptions.model_fields)
    for name, option in described.items():
        assert option["description"]
        assert option["default"] == getattr(RecoveryOptions(), name)
        for value in option["values"] or []:
            assert getattr(parse_options({name: value}), name) == value
        for bound, beyond in (("minimum", -1), ("maximum", 1)):
            if option[bound] is not None:
                assert getattr(parse_options({name: option[bound]}), name) == option[bound]
                with pytest.raises(OptionError):
                    parse_options({name: option[bound] + beyond})
    assert (described["tile"]["minimum"], described["tile"]["maximum"]) == (16, 1024)
    assert described["method"]["values"] == ["pyramid", "nn-dgsr"]
