"""The web app's glass as a module of JavaScript for other pages, with a page that uses it."""

from string import Template
from typing import IO

from services.api.mattes.live_page import PAGE, bundle_module
from storage.layout.mattes import Matte
from workflows.composite.live.encode import encode_live
from workflows.threads import CORES

FOLDER = PAGE.parent / "module"
LIVE = "matte.live"


def write_page(matte: Matte, file: IO[bytes], lookups: int) -> None:
    """Write a page with the monitor of a matte in it."""
    wide, high = matte.attributes["monitor"]
    text = Template((FOLDER / "glass.html").read_text()).substitute(monitor=f"{wide}, {high}")
    file.write(text.encode())


def write_module(matte: Matte, file: IO[bytes], lookups: int) -> None:
    """Write the module with all that it imports: the same for every matte."""
    file.write(bundle_module(FOLDER / "envmatte.js").encode())


def write_live(matte: Matte, file: IO[bytes], lookups: int) -> None:
    """Write a matte as the web app gets it, with as many lookups of a pixel as it has."""
    file.write(encode_live(matte, CORES))


FILES = {"glass.html": write_page, "envmatte.js": write_module, LIVE: write_live}
