"""The reserve of a SQLite database, on a real disk without a free byte."""

import os
import shutil
from pathlib import Path

from storage.database.disk_reserve import keep_reserve
from storage.database.engine import open_engine, reading, writing
from storage.records import jobs, leases
from tests.parts.disks import small_disk


def test_rows_change_and_go_on_a_full_disk(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 32 << 20) as disk:
        engine = open_engine(f"sqlite:///{disk / 'ledger.db'}")
        for _ in range(2):  # the second time, nothing is missing
            keep_reserve(engine)
            assert (disk / "ledger.db-wal").stat().st_size == 8 << 20
            assert (4 << 20) < (disk / "ledger.db").stat().st_size < (5 << 20)
        with writing(engine) as c:
            made = [jobs.add(c, "recover", "c", {}) for _ in range(200)]
            token = leases.acquire(c, "coordinator")
        assert token is not None
        with (disk / "filler").open("wb") as filler:
            os.posix_fallocate(filler.fileno(), 0, shutil.disk_usage(disk).free)
        assert shutil.disk_usage(disk).free == 0
        for job in made:
            with writing(engine) as c:
                leases.renew(c, token, {"workers": ["x" * 10_000]})
                jobs.cancel(c, job)
        for job in made[1:]:
            with writing(engine) as c:
                jobs.delete(c, job)
        with reading(engine) as c:
            assert [line.text for line in jobs.log_lines(c, made[0], 0, 9)] == ["queued", "cancelled"]
        engine.dispose()
