"""Where a process is: recorded by its working thread, answered by another."""

from __future__ import annotations

from queue import SimpleQueue

import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.whereabouts import Place, Whereabouts, is_whereabouts, read_whereabouts

KEY = "evedrop/r1/telemetry/eve"


def test_a_process_says_where_it_is_when_it_is_asked() -> None:
    """The slot, and the keys that it waits on just then."""
    place, answers = Place(), SimpleQueue[bytes]()
    place.answer(answers.put)
    place.slot = 7
    with place.waiting("evedrop/r1/downlink/eve"):
        place.ask()
        waiting = Reader(KEY, answers.get(timeout=60.0))
    place.ask()
    working = Reader(KEY, answers.get(timeout=60.0))
    assert is_whereabouts(waiting)
    assert read_whereabouts(waiting, 10) == Whereabouts(7, ("evedrop/r1/downlink/eve",))
    assert read_whereabouts(working, 10) == Whereabouts(7, ())


def test_more_keys_than_a_run_has_and_slots_beyond_it_are_refused() -> None:
    """The observer keeps what it is told."""
    many = Whereabouts(7, tuple(f"key{i}" for i in range(4097)))
    with pytest.raises(MalformedMessage, match="4097 keys in waits; expected 4096 at most"):
        read_whereabouts(Reader(KEY, many.pack()), 10)
    with pytest.raises(MalformedMessage):
        read_whereabouts(Reader(KEY, Whereabouts(11, ()).pack()), 10)
