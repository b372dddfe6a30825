"""`envmatte demo`: what it refuses."""

import pytest
from click.testing import CliRunner

from services.cli.main import main


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["-o", "q.jpg"], "--output: q.jpg: the name must end in .png"),
        (["--workers", "0"], "'--workers': 0 is not in the range"),
        (["--url", "localhost:8000"], "--url: 'localhost:8000' is not the URL of a service"),
    ],
)
def test_wrong_options_of_the_demo_are_refused_before_it_begins(
    arguments: list[str], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.cli.demo_run.run", lambda *_, **__: pytest.fail("it began"))
    done = CliRunner().invoke(main, ["demo", *arguments])
    assert done.exit_code == 2
    assert reason in " ".join(done.stderr.split())
