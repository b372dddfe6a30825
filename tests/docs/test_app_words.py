"""The words of the app: the same in each language, all in use, and none of them elsewhere in the sources."""

import ast
import json
import re
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

from workflows.composite.video import steps as video_steps
from workflows.ingest import steps as ingest_steps
from workflows.mattes import steps as matte_steps

WEB = Path(__file__).parents[2] / "services" / "web"
WORDS = sorted((WEB / "app" / "words").glob("*.js"))
OF_SERVICE = sorted((WEB / "app" / "words" / "service").glob("*.js"))
"""What the service says, in languages other than its own: its sentences, with {places} for what differs."""
FOR_OTHERS = WEB / "module"
"""What pages of other people are made of: it says nothing in the app."""
SCRIPTS = [
    path
    for path in sorted(WEB.rglob("*.js"))
    if path not in WORDS + OF_SERVICE and FOR_OTHERS not in path.parents
]
PAGES = [path for path in sorted(WEB.rglob("*.html")) if FOR_OTHERS not in path.parents]
SAYING = [
    "services/api/jobs/wait_reason.py",
    "services/runtime/problems.py",
    "workflows/ingest/report/findings.py",
    "workflows/ingest/report/frame_findings.py",
    "workflows/ingest/report/limits.py",
    "workflows/ingest/video/missing_patterns.py",
    "workflows/programs/preset_names.py",
    "workflows/recovery/dgsr/options.py",
    "workflows/untrusted/validation.py",
]
"""Modules of which everything that people read is translated."""
PROGRAMS = "webgl.js"
"""A script whose texts are programs of the graphics card."""
COMMENT = re.compile(r"(?<!:)//[^\n]*|<!--.*?-->", re.DOTALL)
QUOTED = re.compile(r'"((?:[^"\\\n]|\\.)*)"')
FOUND = re.compile(r"\b(?:t|parts|known)\(`((?:[^`$]|\$\{[^{}]*\})*)`")
"""A key that is put together of parts."""
SENTENCE = re.compile(r"(?<![-\w])[A-Z][a-z]+(?:[ .,:]|$)|[a-z]{2,} (?:[a-z]{2,}\b)")
BACKTICK = re.compile(r"(?<=\()/[^/\n]*`[^/\n]*/")
"""A regular expression with backticks, which start no text."""
NAMES = {
    # What the code calls things: keys of the keyboard, headers, backdrops, types of drags, selectors.
    *(
        "Arrow",
        "Escape",
        "Location",
        "Files",
        "Checker",
        "Dusk",
        "Lights",
        "Tiles",
        "picture stage",
        "#own input",
        "Bearer ",
        "Enter",
        "Backspace",
    ),
    *("Deutsch", "English"),  # each language in its own words
}


def words(path: Path) -> dict[str, str]:
    """The words of a file, which are an object of JSON but for its last comma."""
    found = re.fullmatch(r"//[^\n]*\nexport const \w+ = (\{\n.*),\n\};\n", path.read_text(), re.DOTALL)
    assert found, path
    return dict(json.loads(found[1] + "}"))


def source(path: Path) -> str:
    return COMMENT.sub("", path.read_text())


def texts(script: str) -> list[str]:
    """The texts in a script; those between backticks without the expressions in them."""
    found: list[str] = []
    open_: list[str] = []  # the marks that end what is open: texts, and expressions in them
    for part in re.findall(r'\\.|"|`|\$\{|\{|\}|[^\\"`${}]+|.', BACKTICK.sub("", script), re.DOTALL):
        inside = open_[-1] if open_ else "}"
        if inside in '"`':
            if part == inside:
                open_.pop()
            elif part == "${" and inside == "`":
                open_.append("}")
                found.append("")
            else:
                found[-1] += part
        elif part in '"`':
            open_.append(part)
            found.append("")
        elif part in ("{", "${"):
            open_.append("}")
        elif part == "}":
            open_.pop()
            found.append("")  # what continues after an expression
    assert open_ == []
    return found


ENGLISH = words(WEB / "app" / "words" / "en.js")


@pytest.mark.parametrize("path", WORDS, ids=lambda path: path.stem)
def test_languages_have_the_same_words_with_the_same_places(path: Path) -> None:
    found = words(path)
    assert list(found) == sorted(found)
    assert found.keys() == ENGLISH.keys()
    for key, text in found.items():
        assert text.strip(), key
        assert Counter(re.findall(r"\{\w+\}", text)) == Counter(re.findall(r"\{\w+\}", ENGLISH[key])), key


def test_all_words_are_used_and_all_that_are_used_exist() -> None:
    text = "".join(map(source, SCRIPTS + PAGES))
    literal = set(QUOTED.findall(text))
    parted = [
        re.compile("".join(r"[\w-]+" if part.startswith("${") else re.escape(part) for part in parts))
        for parts in (re.split(r"(\$\{[^{}]*\})", one) for one in FOUND.findall(text))
    ]
    unused = [key for key in ENGLISH if key not in literal and not any(one.fullmatch(key) for one in parted)]
    assert unused == []
    named = re.findall(r'\b(?:t|parts)\("([^"]+)"', text) + re.findall(r'data-(?:word|label)="([^"]+)"', text)
    assert [key for key in named if key not in ENGLISH] == []
    keys = [key for path in WORDS for key in words(path)]
    assert [one.pattern for one in parted if not any(map(one.fullmatch, keys))] == []


@pytest.mark.parametrize("path", [p for p in SCRIPTS if p.name != PROGRAMS], ids=lambda path: path.name)
def test_scripts_have_no_words_of_their_own(path: Path) -> None:
    script = re.sub(r"^import .*", "", source(path), flags=re.MULTILINE)
    wrong = [text for text in texts(script) if SENTENCE.search(text) and text not in NAMES]
    assert wrong == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: f"{path.parent.name}")
def test_pages_have_no_words_of_their_own(path: Path) -> None:
    text = re.sub(r"<(script|title|style)\b.*?</\1>", "", source(path), flags=re.DOTALL)
    # What is read without scripts stands there in both languages.
    text = re.sub(r"<p(?: [^>]*)?>[^<]*<span lang=.*?</p>", "", text)
    text = text.replace("&nbsp;", "")
    shown = [one.strip() for one in re.findall(r">([^<>]+)<", text)]
    assert [one for one in shown if re.search("[A-Za-z]", one) and one != "envmatte" and "$" not in one] == []
    assert re.findall(r'(?:aria-label|title|placeholder)="', text) == []


@pytest.mark.parametrize("steps", [ingest_steps, matte_steps, video_steps], ids=lambda one: one.STEPS.kind)
def test_stage_of_a_job_has_words(steps: ModuleType) -> None:
    assert f"stage.{steps.STEPS.stage}" in ENGLISH
    assert all(steps.STEPS.stage in words(path) for path in OF_SERVICE)  # for the log


def literals(path: Path, *, with_docstrings: bool = False) -> list[str]:
    """The texts in a module of Python; a text with values in it is in parts."""
    tree = ast.parse(path.read_text())
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return [
        " ".join(node.value.split())
        for node in constants
        if isinstance(node.value, str) and (with_docstrings or id(node) not in docstrings)
    ]


def phrases(text: str) -> list[str]:
    """The parts of a text, between values and marks, that are more than a word."""
    parts = [part.strip(" .,;:()") for part in re.split(r"\{\w+\}|[.,;:] ", text)]
    return [part for part in parts if re.search(r"[A-Za-z']{2} (?:.* )?[A-Za-z']{2}", part)]


@pytest.mark.parametrize("path", OF_SERVICE, ids=lambda path: path.stem)
def test_sentences_of_the_service_are_those_that_it_says(path: Path) -> None:
    root = WEB.parents[1]
    modules = [
        path for floor in ("services", "workflows", "storage") for path in (root / floor).rglob("*.py")
    ]
    everything = "\n".join(text for module in modules for text in literals(module, with_docstrings=True))
    sentences = words(path)
    assert list(sentences) == sorted(sentences)
    stale = {text: [part for part in phrases(text) if part not in everything] for text in sentences}
    assert {text: parts for text, parts in stale.items() if parts} == {}
    for sentence, translation in sentences.items():
        places, translated = (re.findall(r"\{\w+\}", text) for text in (sentence, translation))
        assert len(set(places)) == len(places), sentence
        assert set(translated) <= set(places), sentence
    known = "\n".join(sentences)
    lacking = {
        name: [part for text in literals(root / name) for part in phrases(text) if part not in known]
        for name in SAYING
    }
    assert lacking == {name: [] for name in SAYING}


def test_each_language_has_the_sentences_of_the_service_but_its_own() -> None:
    assert {path.stem for path in OF_SERVICE} == {path.stem for path in WORDS} - {"en"}
