"""The READMEs: short, in plain words, and every link, file, test and command in them exists."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

from tests.docs.readmes import READMES, ROOT, anchors, blocks, links, prose, read

LINES = 250
DIALECT = r"\b(?:whoever|anew|told|he who|his|for who)\b"
RUN_BY = {
    "tests/docs/test_readmes.py::test_commands_of_pytest_find_tests": [
        ("docker/README.md", "What it survives"),
        ("tests/README.md", "Running them"),
    ],
    "tests/end_to_end/use/test_demo.py::test_demo_writes_its_picture_and_files": [
        ("README.md", "Install and try it")
    ],
    "tests/end_to_end/use/test_readme.py::test_first_composite_by_command_curl_and_client": [
        ("README.md", "Your first composite")
    ],
    "tests/end_to_end/use/test_readme.py::test_from_a_film_to_composites": [
        ("README.md", "Film your own glass"),
        ("README.md", "Command line and Python"),
    ],
    "tests/end_to_end/use/test_readme.py::test_service_scales_to_three_machines": [
        ("README.md", "Scale out")
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_keys_are_made_and_backups_taken": [
        ("README.md", "Run the service"),
        ("README.md", "Security and backups"),
        ("services/README.md", "Keys, owners, limits"),
        ("storage/README.md", "Backups"),
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_completion_is_enabled": [
        ("services/cli/README.md", "Shell completion")
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_webhook_is_verified_by_the_example": [
        ("services/webhooks/README.md", "The secret"),
        ("services/webhooks/README.md", "Verifying"),
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_patterns_are_written_as_video_and_as_pictures": [
        ("workflows/programs/README.md", "As a video"),
        ("workflows/programs/README.md", "As pictures"),
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_stills_of_a_tethered_camera_are_recovered": [
        ("workflows/programs/README.md", "While the camera takes it"),
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_program_is_created_with_curl": [
        ("workflows/programs/README.md", "In the browser")
    ],
    "tests/end_to_end/use/test_folder_readmes.py::test_matte_is_exported_imported_and_read": [
        ("workflows/mattes/README.md", "Layers for other tools"),
        ("workflows/mattes/README.md", "Moving a matte elsewhere"),
        ("workflows/mattes/README.md", "Reading a matte without envmatte"),
        ("services/client/envmatte/README.md", "Open a matte"),
    ],
}
"""The sections whose commands each test runs."""
COMMANDS = [
    (b.readme, b.section) for readme in READMES for b in blocks(readme) if b.language != "json" and b.is_run
]


@pytest.mark.parametrize("readme", READMES)
def test_a_readme_is_short(readme: str) -> None:
    assert len(read(readme).splitlines()) <= LINES


@pytest.mark.parametrize("readme", READMES)
def test_a_readme_uses_plain_words(readme: str) -> None:
    assert re.findall(DIALECT, prose(readme), re.I) == []


@pytest.mark.parametrize("readme", READMES)
def test_links_lead_somewhere(readme: str) -> None:
    for link in links(readme):
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / readme).parent / path if path else ROOT / readme
        assert target.resolve().is_relative_to(ROOT), link
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(str(target.resolve().relative_to(ROOT))), link


@pytest.mark.parametrize("readme", READMES)
def test_files_that_are_named_exist(readme: str) -> None:
    if readme.endswith("CHANGELOG.md"):
        return
    folder = (ROOT / readme).parent
    for name in re.findall(r"`([\w./-]+/|[\w./-]*\w\.(?:py|yaml|sh|js|lock))`", prose(readme)):
        if name in ("a/b.py", "tests/a/test_b.py", "kit.py", "demo/") or re.match(
            r"(?:uploads|captures|mattes|composites)/[A-Z]", name
        ):
            continue
        assert any((start / name).exists() for start in (folder, ROOT)), name


@pytest.mark.parametrize("readme", READMES)
def test_modules_that_are_named_exist(readme: str) -> None:
    for module in re.findall(r"python -m ([\w.]+)", read(readme)):
        assert importlib.util.find_spec(module), module
    for script in re.findall(r"python ([\w/]+\.py)", read(readme)):
        assert (ROOT / script).exists(), script


def test_tests_that_are_named_exist() -> None:
    named = [
        (readme, *found)
        for readme in READMES
        for found in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", read(readme))
    ]
    assert len(named) > 20
    missing = [name for name in named if not _has(name[1], name[2])]
    assert missing == []


def test_every_command_is_run_or_says_why_not() -> None:
    assert sorted(set(COMMANDS)) == sorted(place for places in RUN_BY.values() for place in places)
    for test in RUN_BY:
        assert _has(*test.split("::")), test


def test_commands_of_pytest_find_tests() -> None:
    commands = [
        line
        for readme in READMES
        for b in blocks(readme)
        for line in b.text.splitlines()
        if line.startswith("pytest ")
    ]
    assert commands
    for command in commands:
        for word in command.split():
            if word.startswith("tests/"):
                assert (ROOT / word.partition("::")[0]).exists(), command
            if word.startswith("--"):
                assert _is_option(word.partition("=")[0]), command


def test_every_folder_of_tests_is_run() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").rglob("test_*.py")}
    assert set(settings["testpaths"]) == {f"tests/{name}" for name in folders}


def test_the_commands_of_the_readme_have_the_shape_that_ci_looks_for() -> None:
    demo, tests = (b.text for b in blocks("README.md") if b.section == "Install and try it")
    assert re.fullmatch(r"python3 -m venv \.venv && .*\.venv/bin/envmatte demo --keep demo\n", demo)
    assert re.fullmatch(r"python3 -m venv .*pytest\n", tests)


def _has(file: str, test: str) -> bool:
    path = ROOT / file
    return path.exists() and f"\ndef {test}(" in path.read_text()


def _is_option(name: str) -> bool:
    """Whether some conftest.py, or pytest itself, has an option."""
    own = "".join(path.read_text() for path in Path(ROOT, "tests").rglob("conftest.py"))
    return f'"{name}"' in own or name in ("--lf", "--durations", "--dist")
