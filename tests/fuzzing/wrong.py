"""A target that fails in every way a parser can."""

import os
from pathlib import Path
from random import Random

from tests.fuzzing.campaign import Refused, Target

MEMORY = 16 << 20
"""Its limit: touching much more could take so long on a busy machine that it counts as a hang."""
EXPECTED = {0: "error", 1: "crash", 2: "memory", 3: "hang"}
"""Kind of failure by the first byte of an input, modulo 12. 4 is refused, any other is accepted."""
SEEDS = range(14)
"""Their inputs have every outcome. The first of a process is not measured: it must not be one of too much memory."""


def make(random: Random, valid: object) -> bytes:
    return random.randbytes(8)


def go_wrong(data: bytes, folder: Path) -> None:
    match data[0] % 12:
        case 0:
            raise KeyError("a")
        case 1:
            os.abort()
        case 2:
            bytearray(2 * MEMORY)[::4096] = b"x" * (MEMORY // 2048)
        case 3:
            while True:
                pass
        case 4:
            raise Refused


WRONG = Target("wrong", make, go_wrong, memory=MEMORY)
