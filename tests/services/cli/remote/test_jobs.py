"""Commands for captures and jobs: interrupts, an absent service, options of a recovery."""

import threading

import pytest
from click.testing import CliRunner

from services.cli.main import main
from services.client import Unreachable
from tests.services.cli.commands import COMMAND, UNREACHABLE, interrupted
from tests.services.client.servers import ok, scripted_server


def test_exit_code_130_and_a_way_to_continue_after_an_interrupted_recovery() -> None:
    arrived = threading.Event()

    def answer(n: int):  # type: ignore[no-untyped-def]
        if n == 3:
            arrived.set()
        return ok()

    with scripted_server(answer) as (url, calls):
        code, stderr = interrupted([*COMMAND, "recover", "c", "--url", url], arrived)
    assert code == 130
    assert "envmatte wait j" in stderr
    assert not any("cancel" in call["call"] for call in calls)


def test_a_service_that_stops_while_a_command_waits_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("services.client._session.PATIENCE", 0.5)
    with scripted_server(lambda n: ok() if n < 2 else None) as (url, _):
        given_up = CliRunner().invoke(main, ["recover", "c", "--url", url])
    assert isinstance(given_up.exception, Unreachable)
    assert "The job continues when the service does: envmatte wait j" in given_up.stderr
    assert [record.getMessage() for record in caplog.records if "trying again" in record.getMessage()] == [
        f"no answer from {url}; trying again for 0.5 s"
    ]


@pytest.mark.parametrize("option", ["region=1", "webhook=https://x", "capture=c", "self=1", "options=1"])
def test_what_is_no_option_of_a_recovery_is_refused(option: str) -> None:
    done = CliRunner().invoke(main, ["recover", "c", "--option", option, *UNREACHABLE])
    assert done.exit_code == 2
    assert "is no option of a recovery" in done.stderr


@pytest.mark.parametrize("option", ["tile=1e400", "tile=NaN", "tile=[-Infinity]", 'method="\\ud800"'])
def test_an_option_that_json_does_not_have_is_refused(option: str) -> None:
    done = CliRunner().invoke(main, ["recover", "c", "--option", option, *UNREACHABLE])
    assert done.exit_code == 2
    assert "can't be sent as JSON" in done.stderr
