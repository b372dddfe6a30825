"""The capture.json of six small patterns, for tests of what is read by it."""

from typing import Any


def record(patterns: list[int], suffix: str = "png", **more: Any) -> dict[str, Any]:
    return {
        "format": "envmatte-capture/1",
        "program": {
            "monitor": {"width": 64, "height": 48},
            "parts": [
                {"kind": "constant", "levels": [0, 0.5, 1]},
                {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 3, "seed": 1},
            ],
        },
        "response": "linear",
        "frames": [{"file": f"{n}.{suffix}", "pattern": p} for n, p in enumerate(patterns)],
    } | more
