"""No folder holds more than a dozen entries: what is more is two ideas, and two folders."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST = 12
UNCOUNTED = {"__init__.py", "__pycache__", "py.typed", "README.md"}
GROWING = {"storage/database/migrations/versions"}
"""Has one entry for each revision of the schema, and none is ever removed."""


def test_no_folder_has_more_than_a_dozen_entries() -> None:
    counts = {
        str(Path(folder).relative_to(ROOT)): len({*folders, *files} - UNCOUNTED)
        for top in ("services", "workflows", "storage", "tests", "docker")
        for folder, folders, files in os.walk(ROOT / top)
        if "__pycache__" not in folder
    }
    assert len(counts) > 50
    assert {folder for folder, count in counts.items() if count > MOST} <= GROWING
