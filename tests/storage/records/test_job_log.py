"""The log of a job."""

from itertools import pairwise

from sqlalchemy import Connection

from storage.records import job_log
from tests.storage.planned import planned


def test_log_lines_after_a_line(connection: Connection) -> None:
    job, other = planned(connection), planned(connection)
    for n in range(5):
        job_log.add(connection, job, f"line {n}")
        job_log.add(connection, other, "of another job")
    read = job_log.lines(connection, job, 0, 3)
    assert [row.text for row in read] == ["queued", "line 0", "line 1"]
    rest = job_log.lines(connection, job, read[-1].line, 100)
    assert [row.text for row in rest] == ["line 2", "line 3", "line 4"]
    assert job_log.lines(connection, job, rest[-1].line, 100) == []
    assert all(a.at <= b.at for a, b in pairwise(read))
