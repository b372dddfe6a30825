"""Programs: how far their playback is."""

from sqlalchemy import Connection

from storage.records import programs


def test_report_that_arrives_after_the_end_of_its_playback_is_ignored(connection: Connection) -> None:
    program = programs.add(connection, {"parts": []})

    def report(playback: str | None, phase: str) -> str:
        programs.set_showing(connection, program, {"playback": playback, "phase": phase})
        state: str = programs.get(connection, program).showing["phase"]
        return state

    assert report("one", "countdown") == "countdown"
    assert report("one", "stopped") == "stopped"
    assert report("one", "countdown") == "stopped"
    assert report("two", "countdown") == "countdown"
    assert report("two", "shown") == "shown"
    assert report("two", "showing") == "shown"
    assert report(None, "countdown") == "countdown"
    assert report(None, "stopped") == "stopped"
    assert report(None, "countdown") == "countdown"
