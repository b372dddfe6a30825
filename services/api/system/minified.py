"""Files for browsers without what only their readers need: comments, spaces, long names."""

import hashlib
from functools import lru_cache
from pathlib import Path

try:
    import minify
except ImportError:  # there are wheels for Linux only: elsewhere files are served as they are
    minify = None

TYPES = {".css": "text/css", ".html": "text/html", ".js": "text/javascript", ".svg": "image/svg+xml"}
"""The media types of what is minified, by suffix."""

if minify is not None:
    minify.config({"html-keep-document-tags": True, "html-keep-end-tags": True, "html-keep-quotes": True})


def minified(text: str, media_type: str) -> str:
    """The text with the same meaning, shorter where the minifier is installed."""
    return str(minify.string(media_type, text)) if minify is not None else text


@lru_cache(maxsize=256)
def minified_file(path: Path, changed: float) -> tuple[bytes, str]:
    """A file of one of `TYPES` and its entity tag; `changed`, when it changed last, keeps it fresh."""
    content = minified(path.read_text(encoding="utf-8"), TYPES[path.suffix]).encode()
    return content, f'"{hashlib.sha256(content).hexdigest()[:32]}"'
