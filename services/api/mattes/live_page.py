"""A web page with one matte that needs no service: styles, scripts and the matte are within its one file."""

import base64
import hashlib
import re
from html import escape
from pathlib import Path
from string import Template

PAGE = Path(__file__).parents[2] / "web" / "standalone"
APP_STYLE = PAGE.parent / "app" / "style.css"
_IMPORT = re.compile(r'^import \{ (.+) \} from "(.+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


def make_page(title: str, monitor: tuple[int, int], live: bytes) -> bytes:
    """Make the page of a matte.

    Parameters
    ----------
    title : str
        Any text.
    monitor : (int, int)
        Width and height of the monitor that the backdrop is stretched over.
    live : bytes
        The matte, as `workflows.composite.live.encode` encodes it.

    Returns
    -------
    bytes
        HTML in UTF-8. Its policy lets it run its own script, and load nothing.
    """
    style, script = _colours() + (PAGE / "page.css").read_text(), bundle(PAGE / "page.js")
    allowed = f"script-src {_hash(script)}; style-src {_hash(style)}"
    policy = f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"
    wide, high = monitor
    return (
        Template((PAGE / "page.html").read_text())
        .substitute(
            policy=policy,
            title=escape(title),
            monitor=f"{wide} {high}",
            style=style,
            matte=base64.b64encode(live).decode(),
            script=script,
        )
        .encode()
    )


def bundle(module: Path) -> str:
    """One script of a module of JavaScript and all that it imports.

    Each module becomes a function that returns what the module exports. They must import by name from files, and
    export declarations, as those of the web app do.
    """
    names: dict[Path, str] = {}
    parts: list[str] = []

    def add(path: Path) -> str:
        if path not in names:

            def linked(found: re.Match[str]) -> str:
                return f"const {{ {found[1]} }} = {add((path.parent / found[2]).resolve())};"

            text = _IMPORT.sub(linked, path.read_text())
            exported = ", ".join(found[2] for found in _EXPORT.finditer(text))
            body = _EXPORT.sub(r"\1", text)
            names[path] = f"module{len(names)}"
            parts.append(f"const {names[path]} = (() => {{\n{body}return {{ {exported} }};\n}})();\n")
        return names[path]

    add(module.resolve())
    return "".join(parts)


def bundle_module(module: Path) -> str:
    """One module of JavaScript with all that a module imports, and with its exports and its first comment."""
    text = module.read_text()
    about = re.split("^import ", text, maxsplit=1, flags=re.MULTILINE)[0]
    exported = ", ".join(found[2] for found in _EXPORT.finditer(text))
    script = bundle(module).replace(about, "")
    (last,) = re.findall(r"^const (module\d+) = ", script, re.MULTILINE)[-1:]
    return f"{about}{script}export const {{ {exported} }} = {last};\n"


def _colours() -> str:
    """The rules of the app's style sheet that name its colours, light and dark."""
    found = re.match(
        r":root \{.*?^\}\n@media \(prefers-color-scheme: dark\) \{.*?^\}\n",
        APP_STYLE.read_text(),
        re.M | re.S,
    )
    assert found is not None
    return found[0]


def _hash(text: str) -> str:
    """The source of a policy that allows an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
