"""How often an outage is logged."""

import logging
import time

import pytest

from storage.outage import Outage


def test_an_outage_is_logged_at_its_beginning_every_half_minute_and_at_its_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    outage = Outage(logging.getLogger("somewhere"))
    caplog.set_level(logging.INFO)
    outage.is_over("it answers")
    while now < 70:
        outage.goes_on("it is away since %d s", now)
        now += 1
    outage.is_over("it answers")
    outage.is_over("it answers")
    outage.goes_on("it is away again")
    every = [f"it is away since {at} s" for at in (0, 30, 60)]
    assert caplog.messages == [*every, "it answers", "it is away again"]


def test_where_some_succeed_an_outage_is_over_after_a_quiet_time(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    outage = Outage(logging.getLogger("somewhere"), quiet=5)
    caplog.set_level(logging.INFO)
    while now < 20:
        outage.goes_on("some fail since %d s", now)
        outage.is_over("all succeed")
        now += 1
    assert caplog.messages == ["some fail since 0 s"]
    now += 5
    outage.is_over("all succeed")
    assert caplog.messages == ["some fail since 0 s", "all succeed"]
