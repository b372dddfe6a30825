"""Every parser accepts or refuses any bytes: none crashes, hangs or takes unbounded memory."""

import os
from pathlib import Path
from random import Random

import pytest

from tests.fuzzing import campaign
from tests.fuzzing.campaign import Refused, Target
from tests.fuzzing.targets import ALL


@pytest.mark.parametrize("target", ALL, ids=[target.name for target in ALL])
def test_damaged_input_is_accepted_or_refused(
    target: Target, tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    times = int(pytestconfig.getoption("--times"))
    tally = campaign.run(target, 0, times * target.quick, tmp_path)
    assert not tally.failures, "\n".join(map(str, tally.failures))
    assert tally.executions == times * target.quick
    assert tally.refused > 0
    assert tally.accepted > 0


def test_input_is_reproducible_from_its_seed() -> None:
    for target in ALL:
        valid = target.valid()
        assert target.input(7) == target.input(7, valid), target.name
        assert len({target.input(seed, valid) for seed in range(20)}) > 10, target.name


def make(random: Random, valid: object) -> bytes:
    return random.randbytes(8)


def go_wrong(data: bytes, folder: Path) -> None:
    """Fail in every way a parser can, or accept or refuse."""
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


MEMORY = 16 << 20
"""Memory limit of that target: touching much more could take so long on a busy machine that it counts as a hang."""
EXPECTED = {0: "error", 1: "crash", 2: "memory", 3: "hang"}


def test_every_kind_of_failure_is_counted_and_its_input_kept(
    tmp_path: Path,
) -> None:
    wrong = Target("wrong", make, go_wrong, memory=MEMORY)
    seeds, inputs = range(25), [wrong.input(seed) for seed in range(25)]
    expected = [
        (EXPECTED[data[0] % 12], seed) for seed, data in zip(seeds, inputs, strict=True) if data[0] % 12 < 4
    ]
    tally = campaign.run(wrong, 0, len(seeds), tmp_path, cpu=1)
    assert [(failure.kind, failure.seed) for failure in tally.failures] == expected
    assert {kind for kind, _ in expected} == {*EXPECTED.values()}
    for failure in tally.failures:
        assert failure.file.read_bytes() == inputs[failure.seed]
    assert tally.executions == len(seeds)
    assert tally.refused == sum(data[0] % 12 == 4 for data in inputs)
    assert tally.accepted == len(seeds) - len(expected) - tally.refused
