"""The status of a process: updated by its working thread, reported by another."""

from __future__ import annotations

from queue import SimpleQueue

import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import ProcessStatus, StatusReporter, is_process_status, read_process_status

KEY = "evedrop/r1/telemetry/eve"


def test_a_process_reports_its_status_on_request() -> None:
    """The slot, and the keys that it waits on just then."""
    reporter, answers = StatusReporter(), SimpleQueue[bytes]()
    reporter.answer(answers.put)
    reporter.slot = 7
    with reporter.waiting("evedrop/r1/downlink/eve"):
        reporter.request()
        waiting = Reader(KEY, answers.get(timeout=60.0))
    reporter.request()
    working = Reader(KEY, answers.get(timeout=60.0))
    assert is_process_status(waiting)
    assert read_process_status(waiting, 10) == ProcessStatus(7, ("evedrop/r1/downlink/eve",))
    assert read_process_status(working, 10) == ProcessStatus(7, ())


def test_more_keys_than_a_run_has_and_slots_beyond_it_are_refused() -> None:
    """The recorder keeps what it is told."""
    many = ProcessStatus(7, tuple(f"key{i}" for i in range(4097)))
    with pytest.raises(MalformedMessage, match=r"Expected `array` of length <= 4096 - at `\$.waits`"):
        read_process_status(Reader(KEY, many.pack()), 10)
    with pytest.raises(MalformedMessage):
        read_process_status(Reader(KEY, ProcessStatus(11, ()).pack()), 10)


@pytest.mark.parametrize("key", ["x", "", "evedrop/r1", "evedrop/r1/" + 600 * "x", "evedrop/r1/control/a\nb"])
def test_what_is_no_key_of_a_run_is_refused(key: str) -> None:
    """An eavesdropper is not trusted, and a failure names the keys that processes wait on: its sender is named."""
    told = ProcessStatus(7, ("evedrop/r1/downlink/eve", key)).pack()
    with pytest.raises(MalformedMessage, match="keys of a run") as refused:
        read_process_status(Reader(KEY, told), 10)
    assert refused.value.at_fault == ("eve",)
