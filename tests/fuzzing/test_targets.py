"""Every parser accepts or refuses any bytes: none crashes, hangs or takes unbounded memory."""

from pathlib import Path

import pytest

from tests.fuzzing import campaign
from tests.fuzzing.campaign import Target
from tests.fuzzing.targets import ALL
from tests.fuzzing.wrong import EXPECTED, SEEDS, WRONG


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


def test_every_kind_of_failure_is_counted_and_its_input_kept(tmp_path: Path) -> None:
    inputs = [WRONG.input(seed) for seed in SEEDS]
    expected = [
        (EXPECTED[data[0] % 12], seed) for seed, data in zip(SEEDS, inputs, strict=True) if data[0] % 12 < 4
    ]
    tally = campaign.run(WRONG, 0, len(SEEDS), tmp_path, cpu=1)
    assert [(failure.kind, failure.seed) for failure in tally.failures] == expected
    assert {kind for kind, _ in expected} == {*EXPECTED.values()}
    for failure in tally.failures:
        assert failure.file.read_bytes() == inputs[failure.seed]
    assert tally.executions == len(SEEDS)
    assert tally.refused == sum(data[0] % 12 == 4 for data in inputs)
    assert tally.accepted == len(SEEDS) - len(expected) - tally.refused
