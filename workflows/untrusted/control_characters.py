"""Control characters in text that others sent: they forge lines of a log, and command terminals."""

import re

CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def escape_controls(text: str) -> str:
    r"""Write control characters as Python does.

    Examples
    --------
    >>> print(escape_controls("glass\n\x1b[2J"))
    glass\n\x1b[2J
    """
    return CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
