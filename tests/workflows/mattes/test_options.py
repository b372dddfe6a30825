"""The options of recovery: parsed, refused by name, and described."""

import inspect
import math
from collections.abc import Callable
from typing import Any

import pytest

from storage.errors import OptionError
from workflows.mattes.options import (
    METHODS,
    DgsrOptions,
    LobesOptions,
    RecoveryOptions,
    describe_options,
    parse_options,
)
from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.lobes import recover as lobes


def test_nothing_asked_for_is_the_defaults() -> None:
    assert parse_options({}) == LobesOptions(tile=None)
    assert parse_options({"method": "nn-dgsr", "tile": 64}) == DgsrOptions(tile=64)
    assert parse_options({"method": "nn-dgsr", "sparsity": 0.1}) == DgsrOptions(sparsity=0.1)


def test_what_is_kept_of_options_gives_the_same_options() -> None:
    for method in METHODS:
        options = method(tile=32)  # type: ignore[call-arg]
        assert parse_options(options.model_dump(mode="json")) == options


@pytest.mark.parametrize(("options", "recover"), [(LobesOptions, lobes.recover), (DgsrOptions, dgsr.recover)])
def test_constants_are_the_methods_keyword_arguments(
    options: Callable[[], RecoveryOptions], recover: Callable[..., object]
) -> None:
    parameters = inspect.signature(recover).parameters.values()
    keywords = {p.name: p.default for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}
    assert options().constants == keywords


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"tile": 15}, "tile"),
        ({"tile": 1025}, "tile"),
        ({"tile": "many"}, "tile"),
        ({"tile": [16]}, "tile"),
        ({"method": "magic"}, "method"),
        ({"method": None}, "method"),
        ({"method": ["lobes"]}, "method"),
        ({"fit_resolution": math.nan}, "fit_resolution"),
        ({"method": "nn-dgsr", "sparsity": math.inf}, "sparsity"),
        ({"tyle": 64}, "tyle"),
        ({"": 1}, ""),
    ],
)
def test_a_refusal_names_the_option(given: dict[str, Any], field: str) -> None:
    with pytest.raises(OptionError) as caught:
        parse_options(given)
    assert caught.value.fields == {"field": field}
    assert repr(field) in caught.value.detail


@pytest.mark.parametrize(
    ("given", "detail"),
    [
        ({"method": "nn-dgsr", "sparsity": 2}, "option 'sparsity': must be between 0.01 and 1"),
        ({"method": "nn-dgsr", "sparsity": "few"}, "option 'sparsity': must be between 0.01 and 1"),
        ({"tile": 15}, "option 'tile': must be a whole number between 16 and 1024"),
        ({"method": "magic"}, "option 'method': must be one of lobes, nn-dgsr"),
        ({"method": "nn-dgsr", "prior": "x"}, "option 'prior': must be one of gaussian, none"),
        ({"sparsity": 0.1}, "option 'sparsity' belongs to the method nn-dgsr, not to lobes"),
        (
            {"method": "nn-dgsr", "most_lobes": 3},
            "option 'most_lobes' belongs to the method lobes, not to nn-dgsr",
        ),
    ],
)
def test_a_refusal_says_what_is_right(given: dict[str, Any], detail: str) -> None:
    with pytest.raises(OptionError) as caught:
        parse_options(given)
    assert caught.value.detail == detail


@pytest.mark.parametrize("method", METHODS)
def test_an_unknown_option_is_told_those_there_are(method: type[RecoveryOptions]) -> None:
    with pytest.raises(OptionError, match=", ".join(method.model_fields)):
        parse_options({"method": method.model_fields["method"].default, "tyle": 64})


def test_every_option_is_described_once_a_method_as_it_is_parsed() -> None:
    described = {(option["method"], option["name"]): option for option in describe_options()}
    assert len(described) == len(describe_options())
    common = set(RecoveryOptions.model_fields)
    assert {name for method, name in described if method is None} == common
    names = described[None, "method"]["values"]
    assert names == ["lobes", "nn-dgsr"]
    assert described[None, "method"]["default"] == parse_options({}).method
    for method, name in zip(METHODS, names, strict=True):
        own = {option for owner, option in described if owner == name}
        assert own | common == set(method.model_fields)
    for (method, name), option in described.items():
        base = {"method": method} if method else {}
        assert option["description"]
        assert option["default"] == getattr(parse_options(base), name)
        for value in option["values"] or []:
            assert getattr(parse_options(base | {name: value}), name) == value
        if option["values"] is None:
            for bound, beyond in (("minimum", -1), ("maximum", 1)):
                assert getattr(parse_options(base | {name: option[bound]}), name) == option[bound]
                with pytest.raises(OptionError):
                    parse_options(base | {name: option[bound] + beyond})
    assert (described[None, "tile"]["minimum"], described[None, "tile"]["maximum"]) == (16, 1024)
