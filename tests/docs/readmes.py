"""The READMEs as data: their code blocks, tables, headings and links."""

import re
import textwrap
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FLOORS = ("services", "workflows", "storage", "docker", "tests")
READMES = sorted(
    [
        "README.md",
        ".github/CONTRIBUTING.md",
        ".github/CHANGELOG.md",
        *(str(path.relative_to(ROOT)) for floor in FLOORS for path in (ROOT / floor).rglob("README.md")),
    ]
)
NOT_RUN = "*Not run by the tests"
"""How a paragraph begins that says why the block before it is not run."""


class Block(NamedTuple):
    """A fenced block of code.

    Attributes
    ----------
    section : str
        The nearest heading above.
    language : str
        What the fence says: sh, python, json.
    is_run : bool
        Whether no paragraph after it says that the tests do not run it.
    """

    readme: str
    section: str
    language: str
    text: str
    is_run: bool


@cache
def read(readme: str) -> str:
    """The text of a README, by its path from the root of the repository."""
    return (ROOT / readme).read_text()


def prose(readme: str) -> str:
    """The same without its blocks of code."""
    return re.sub(r"^ *```\w*\n.*?^ *```$", "", read(readme), flags=re.S | re.M)


def blocks(readme: str) -> list[Block]:
    """Every block of code of a README, in order."""
    text, found = read(readme), []
    for match in re.finditer(r"^( *)```(\w+)\n(.*?)^\1```$", text, re.S | re.M):
        above = re.findall(
            r"^#+ (.*)$", re.sub(r"^ *```.*?^ *```$", "", text[: match.start()], flags=re.S | re.M), re.M
        )
        is_run = not text[match.end() :].lstrip().startswith(NOT_RUN)
        found.append(Block(readme, above[-1], match[2], textwrap.dedent(match[3]), is_run))
    return found


def block(readme: str, section: str, language: str = "sh", number: int = 0) -> str:
    """The text of a block of code, by its README, its section, and its place among those of its language there."""
    found = [b.text for b in blocks(readme) if (b.section, b.language) == (section, language)]
    return found[number]


def headings(readme: str) -> list[str]:
    """Every heading of a README, without its hashes."""
    return re.findall(r"^#+ (.*)$", prose(readme), re.M)


def anchors(readme: str) -> set[str]:
    """What links to the sections of a README end with, as GitHub makes it."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(readme)}


def links(readme: str) -> list[str]:
    """Where the links and pictures of a README lead."""
    return re.findall(r"\]\(([^)\s]+)\)", prose(readme))


def table(readme: str, *head: str) -> list[list[str]]:
    """The cells of every table of a README that has these columns, row by row.

    Raises
    ------
    LookupError
        If there is none.
    """
    rows, found = [], False
    for part in re.findall(r"(?:^ *\|.*\|$\n?)+", read(readme), re.M):
        lines = [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in part.splitlines()]
        if tuple(lines[0]) == head:
            found = True
            rows += lines[2:]
    if not found:
        raise LookupError(f"{readme} has no table with the columns {', '.join(head)}")
    return rows


def codes(cell: str) -> list[str]:
    """What stands in backticks in a cell of a table."""
    return re.findall(r"`([^`]+)`", cell)
