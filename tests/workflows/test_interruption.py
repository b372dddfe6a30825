"""Work that ends early, in the thread that began it and in others."""

import pytest

from workflows.interruption import checkpoint, interruptible
from workflows.threads import in_parts


@pytest.mark.parametrize("threads", [1, 3])
def test_parts_on_all_threads_end_by_the_check(threads: int) -> None:
    begun: list[int] = []

    def check() -> None:
        if len(begun) >= 5:
            raise TimeoutError

    with interruptible(check), pytest.raises(TimeoutError):
        in_parts(begun.append, range(1000), threads)
    assert 5 <= len(begun) < 5 + threads
    checkpoint()
