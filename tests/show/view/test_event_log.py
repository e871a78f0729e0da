"""The document of events: none of the future, the newest first."""

from __future__ import annotations

from evedrop.show.view.event_log import EventLog, LogLine


def line(at: float, text: str, level: str = "INFO") -> LogLine:
    """A line of slot `at`."""
    return LogLine(at, f"#{at:g}", level, text)


def test_each_moment_shows_the_events_up_to_it() -> None:
    """The newest first; a warning has its level, and events of one moment share a version."""
    log = EventLog()
    moments, texts = log.add([line(3, "b", "WARN"), line(1, "a"), line(3, "c")])
    assert moments == [1, 3]
    assert texts == ["#1   a", "#3   c\n#3   WARN   b\n#1   a"]
    assert log.add([]) == ([], [])


def test_an_event_that_is_noticed_late_appears_at_its_moment() -> None:
    """The versions of later moments have it as well."""
    log = EventLog()
    log.add([line(1, "a"), line(9, "c")])
    assert log.add([line(5, "b")]) == ([5, 9], ["#5   b\n#1   a", "#9   c\n#5   b\n#1   a"])


def test_a_document_has_the_last_sixteen_events() -> None:
    """However many there were, and however they are divided into calls."""
    log = EventLog()
    texts = [text for k in range(3000) for text in log.add([line(k, "x")])[1]]
    assert texts[-1].splitlines() == [f"#{k}   x" for k in range(2999, 2983, -1)]
    assert texts[4].splitlines() == [f"#{k}   x" for k in range(4, -1, -1)]
