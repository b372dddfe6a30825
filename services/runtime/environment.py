"""What the environment says: the variables ``ENVMATTE_…`` and the lines of the file ``.env``.

Apart from `services.settings`, because `envmatte keys` needs no more of the settings than the database, and pydantic
takes longer to import than all that command does.
"""

import os
from collections.abc import Container
from pathlib import Path
from urllib.parse import quote

PREFIX = "ENVMATTE_"
FILE = Path(".env")
DATA = Path("envmatte-data")
"""The data folder, unless the environment or an option names another."""


def read_environment(names: Container[str]) -> dict[str, str]:
    """The values of some settings. A variable wins over the file, and empty values count as not set.

    Parameters
    ----------
    names : container of str
        Names of settings, as ``worker_memory`` for ``ENVMATTE_WORKER_MEMORY``.
    """
    return {name: value for name, value in _all().items() if name in names}


def unknown_variables(names: Container[str]) -> list[str]:
    """The variables ``ENVMATTE_…`` and lines of the file that set none of these, such as misspelt ones."""
    return sorted(PREFIX + name.upper() for name in _all() if name not in names)


def _all() -> dict[str, str]:
    lines: dict[str, str | None] = {}
    # Not `Path.is_file`, which fails in a working directory that this user may not search.
    if os.path.isfile(FILE):
        from dotenv import dotenv_values

        lines = dotenv_values(FILE)
    found = {}
    for variable, value in [*lines.items(), *os.environ.items()]:
        prefix, name = variable[: len(PREFIX)].upper(), variable[len(PREFIX) :].lower()
        if value and prefix == PREFIX:
            found[name] = value
    return found


def database_url(data: Path, database: str | None) -> str:
    """Where the database is, as SQLAlchemy takes it: as named, or in the data folder."""
    return database or f"sqlite:///{quote(str(data.resolve() / 'envmatte.db'))}"
