"""The tables of the READMEs against the code: nothing is missing, nothing is too much, and defaults are right."""

import json
import re
from collections.abc import Iterator
from typing import Any

import click
import pytest

from services.api.app import build_app
from services.cli.main import main
from services.runtime.problems import PROBLEMS
from services.settings import Settings, describe_settings
from storage.database.engine import open_engine
from storage.objects.store import Objects
from tests.docs.readmes import block, codes, prose, table
from workflows.ingest.manifest import EXAMPLE
from workflows.mattes.options import describe_options
from workflows.programs.presets import RECIPES, preset

UNITS = {"KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30, "day": 86_400, "days": 86_400, "s": 1}


@pytest.fixture(scope="module")
def openapi(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("docs")
    engine = open_engine(f"sqlite:///{folder / 'envmatte.db'}")
    document = build_app(Settings(data=folder), engine, Objects(folder.as_uri())).openapi()
    engine.dispose()
    return document


def number(text: str) -> float | None:
    """A number as tables write it, 20,000 or 8 GiB or 1 day; None if it is no such."""
    match = re.fullmatch(r"(\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?)(?: (\w+))?", text)
    return float(match[1].replace(",", "")) * UNITS[match[2] or "s"] if match else None


def same(cell: str, value: object) -> bool:
    """Whether a cell of a table shows a default."""
    if isinstance(value, bool):
        return cell == str(value).lower()
    if isinstance(value, int | float):
        return number(cell) == value
    return codes(cell) == [str(value)]


@pytest.mark.parametrize("readme", ["README.md", "services/README.md"])
def test_table_of_settings_agrees_with_the_code(readme: str) -> None:
    rows = {
        name: default
        for cell, default, _ in table(readme, "setting", "default", "meaning")
        for name in codes(cell)
    }
    described = {one.variable: one.default for one in describe_settings()}
    assert rows.keys() <= described.keys()
    assert readme == "README.md" or rows.keys() == described.keys()
    for name, cell in rows.items():
        plain, expected = cell.replace("`", ""), described[name].partition(":")[0].replace("`", "")
        value = number(expected.partition(" ")[0])
        assert plain == expected if value is None else number(plain) == value, name


def test_table_of_routes_agrees_with_the_code(openapi: dict[str, Any]) -> None:
    documented = [
        (method, path)
        for methods, paths, _ in table("services/api/README.md", "method", "path", "does")
        for method in codes(methods)
        for path in codes(paths)
    ]
    declared = [(method.upper(), path) for path, item in openapi["paths"].items() for method in item]
    assert sorted(documented) == sorted(declared)


def test_table_of_problems_agrees_with_the_code() -> None:
    documented = [
        (codes(slug)[0], int(status))
        for slug, status, _ in table("services/api/README.md", "slug", "status", "when")
    ]
    assert len(documented) == len(set(documented))
    assert set(documented) == {(slug, int(status)) for status, slug, _ in PROBLEMS.values()}


def test_table_of_parameters_of_composites_agrees_with_the_code(openapi: dict[str, Any]) -> None:
    rows = {
        codes(name)[0]: default
        for name, default, _ in table("workflows/composite/README.md", "parameter", "default", "meaning")
    }
    parameters = openapi["paths"]["/v1/mattes/{id}/composite"]["post"]["parameters"]
    declared = {one["name"]: one["schema"].get("default") for one in parameters if one["in"] == "query"}
    assert rows.keys() == declared.keys()
    for name, value in declared.items():
        assert number(rows[name]) is None if value is None else same(rows[name], value), name


def test_table_of_options_of_recovery_agrees_with_the_code() -> None:
    documented = [
        (codes(name)[0], (codes(method) or [None])[0], default, values)
        for name, method, default, values in table(
            "workflows/recovery/README.md", "option", "method", "default", "range"
        )
    ]
    described = describe_options()
    assert [row[:2] for row in documented] == [(one["name"], one["method"]) for one in described]
    for (name, _, default, values), one in zip(documented, described, strict=True):
        if one["type"] == "boolean":
            assert (codes(default), codes(values)) == ([str(one["default"]).lower()], ["true", "false"]), name
            continue
        assert number(default) is None if one["default"] is None else same(default, one["default"]), name
        if one["values"]:
            assert codes(values) == one["values"], name
        else:
            assert [number(end) for end in values.split(" to ")] == [one["minimum"], one["maximum"]], name


def test_cost_of_the_quality_fast_is_that_of_the_results() -> None:
    """The README and the option say what the table of results does."""
    results = {
        method: [[float(figure) for figure in re.findall(r"\d+\.\d", cell)] for cell in cells]
        for method, _, *cells in table(
            "workflows/recovery/README.md",
            *("method", "frames", "clear ball", "tinted bunny, dispersion", "frosted lens"),
        )
    }
    fine = results["`lobes`, preset `default`"]
    fast = results["`lobes`, preset `default`, `quality: fast`"]
    costs = [before[0] - after[0] for before, after in zip(fine, fast, strict=True)]
    slowest = max(range(len(fine)), key=lambda scene: fine[scene][1])
    assert fast[slowest][1] / fine[slowest][1] == pytest.approx(4 / 5, abs=0.05)
    (quality,) = [one for one in describe_options() if one["name"] == "quality"]
    for said in (quality["description"], prose("workflows/recovery/README.md")):
        assert f"takes four fifths of the time and costs {min(costs):.1f} to {max(costs):.1f} dB" in said


def test_table_of_commands_agrees_with_the_code() -> None:
    documented = [codes(name)[0] for name, _ in table("services/cli/README.md", "command", "does")]
    assert sorted(documented) == sorted(f"envmatte {name}" for name in _commands(main))


@pytest.mark.parametrize("readme", ["README.md", "workflows/programs/README.md"])
def test_table_of_presets_agrees_with_the_code(readme: str) -> None:
    found = {}
    for names, frames, _ in table(readme, "preset", "frames", "use it for"):
        colour = "rgb" if "in colour" in frames else "grey"
        found |= {
            name: (int(count), colour)
            for name, count in zip(codes(names), re.findall(r"\d+", frames), strict=True)
        }
    assert found == {name: (preset(name).count, RECIPES[name].colour) for name in RECIPES}


def test_example_of_a_capture_is_valid() -> None:
    assert json.loads(block("workflows/ingest/README.md", "The capture format", "json")) == EXAMPLE


def _commands(group: click.Group, *above: str) -> Iterator[str]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _commands(command, *above, name)
        else:
            yield " ".join([*above, name])
