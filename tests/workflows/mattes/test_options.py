"""The options of recovery: parsed, refused by name, and described from one declaration."""

import inspect
import math
from collections.abc import Callable
from typing import Any, get_args

import pytest

from storage.errors import OptionError
from workflows.mattes.options import METHODS, RecoveryOptions, describe_options, parse_options
from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.dgsr.options import Constants, DgsrOptions
from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.options import FAST, LobesOptions
from workflows.recovery.options import declared_options


def test_missing_options_have_their_defaults() -> None:
    lobes_model, dgsr_model = METHODS
    assert parse_options({}) == lobes_model.model_validate({"tile": None})
    assert parse_options({"method": "nn-dgsr", "tile": 64}) == dgsr_model.model_validate({"tile": 64})
    assert parse_options({"method": "nn-dgsr", "sparsity": 0.1}) == dgsr_model.model_validate(
        {"sparsity": 0.1}
    )


def test_stored_options_parse_to_the_same_options() -> None:
    for method in METHODS:
        options = method.model_validate({"tile": 32})
        assert parse_options(options.model_dump(mode="json")) == options


@pytest.mark.parametrize(
    ("method", "recover", "kind"),
    [(METHODS[0], lobes.recover, LobesOptions), (METHODS[1], dgsr.recover, DgsrOptions)],
)
def test_models_documentation_and_recover_share_one_declaration(
    method: type[RecoveryOptions], recover: Callable[..., object], kind: type[tuple[Any, ...]]
) -> None:
    assert method.declared is kind
    assert inspect.signature(recover).parameters["options"].default == kind()
    name = method.model_fields["method"].default
    assert parse_options({"method": name}).of_method == kind()
    documented = {option["name"]: option for option in describe_options() if option["method"] == name}
    for option in declared_options(kind):
        field = documented[option.name]
        assert field["description"] == option.description
        assert field["default"] == option.default
        if option.range:
            assert (field["minimum"], field["maximum"]) == option.range
            assert option.range.least <= option.default <= option.range.most
        else:
            assert field["values"] == list(get_args(option.type))


def test_values_reach_recover() -> None:
    assert parse_options({"most_lobes": 5, "tile": 32}).of_method == LobesOptions(most_lobes=5)
    given = {"method": "nn-dgsr", "prior": "none", "clusters": 2}
    assert parse_options(given).of_method == DgsrOptions(prior="none", constants=Constants(clusters=2))


def test_fast_replaces_defaults_only() -> None:
    assert parse_options({"quality": "fast"}).of_method == FAST
    assert parse_options({"quality": "fast", "steps": 7}).of_method == FAST._replace(steps=7)
    assert parse_options({"quality": "fine"}).of_method == LobesOptions()


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
def test_error_names_the_option(given: dict[str, Any], field: str) -> None:
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
        ({"cut_out": "maybe"}, "option 'cut_out': must be true or false"),
        ({"cut_out": None}, "option 'cut_out': must be true or false"),
        ({"method": "magic"}, "option 'method': must be one of lobes, nn-dgsr"),
        ({"method": "nn-dgsr", "prior": "x"}, "option 'prior': must be one of gaussian, none"),
        ({"sparsity": 0.1}, "option 'sparsity' belongs to the method nn-dgsr, not to lobes"),
        (
            {"method": "nn-dgsr", "most_lobes": 3},
            "option 'most_lobes' belongs to the method lobes, not to nn-dgsr",
        ),
    ],
)
def test_error_says_what_is_allowed(given: dict[str, Any], detail: str) -> None:
    with pytest.raises(OptionError) as caught:
        parse_options(given)
    assert caught.value.detail == detail


@pytest.mark.parametrize("method", METHODS)
def test_error_for_an_unknown_option_lists_the_known_ones(method: type[RecoveryOptions]) -> None:
    with pytest.raises(OptionError, match=", ".join(method.model_fields)):
        parse_options({"method": method.model_fields["method"].default, "tyle": 64})


def test_every_option_is_described_once_per_method_as_it_is_parsed() -> None:
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
        if option["type"] == "boolean":
            assert getattr(parse_options(base | {name: not option["default"]}), name) is not option["default"]
        elif option["values"] is None:
            for bound, beyond in (("minimum", -1), ("maximum", 1)):
                assert getattr(parse_options(base | {name: option[bound]}), name) == option[bound]
                with pytest.raises(OptionError):
                    parse_options(base | {name: option[bound] + beyond})
    assert (described[None, "tile"]["minimum"], described[None, "tile"]["maximum"]) == (16, 1024)
