"""How a run ends, as its recorder tells it."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from evedrop.errors import Interrupted, MalformedMessage, NoAnswer, RunError, UnwrittenResults
from evedrop.live.recorder import recorder
from evedrop.live.recorder.run_end import RunEnd


@pytest.mark.parametrize(("error", "suspects"), [(RunError("why"), ("eve",)), (UnwrittenResults("no space"), ())])
def test_nobody_is_blamed_for_a_disk(error: RunError, suspects: tuple[str, ...]) -> None:
    """A process that is cut off while the disk is full has not filled it."""
    end = RunEnd()
    end.blame(["eve"], error)
    assert end.suspects == suspects


def test_who_was_missing_has_not_filled_the_disk_afterwards() -> None:
    """An interrupted run whose summary cannot be written names the disk alone."""
    end = RunEnd()
    end.take(Interrupted("interrupted"))
    end.blame(["eve"], Interrupted("interrupted"))
    with end.noted():
        raise OSError(28, "No space left on device")
    assert end.how.startswith("the results cannot be written ([Errno 28] No space left on device)")
    assert end.suspects == ()


@pytest.mark.parametrize(
    ("later", "saved"),
    [
        (OSError(28, "No space left on device"), False),
        (NoAnswer("it did not answer within 10 s"), True),
        (MemoryError(), True),
    ],
)
def test_the_first_failure_names_who_is_at_fault(later: Exception, saved: bool) -> None:
    """Even if the results cannot be written then, or have no metrics."""
    end = RunEnd()
    end.take(RunError("why"))
    end.blame(["eve"], RunError("why"))
    with end.noted():
        raise later
    end.fail("the summary cannot be written")
    assert (end.how, end.suspects, end.saved) == ("why", ("eve",), saved)


@pytest.mark.parametrize(
    ("named", "suspects"), [(("sensor",), ("sensor",)), ((), ("sensor", "eve")), (("sensor", "router"), ("router",))]
)
def test_who_waits_for_a_missing_process_is_not_to_blame(named: tuple[str, ...], suspects: tuple[str, ...]) -> None:
    """Nor who is missing just now, if the error names others."""
    end, error = RunEnd(), RunError("why")
    error.missing = named
    end.blame(["sensor", "eve"], error)
    assert end.suspects == suspects


@pytest.mark.parametrize(("unexplained", "status"), [(0, 0), (1, 3)])
def test_a_run_with_packets_that_are_unaccounted_for_has_failed(unexplained: int, status: int) -> None:
    """Even if all its slots are done."""
    links = {"legitimate": Mock(unexplained=0), "eve": Mock(unexplained=unexplained)}
    end = RunEnd()
    end.judge(Mock(links=links, ended=end.how, failed_expectations=()))
    assert end.status == status


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (UnwrittenResults("no space"), "no space"),
        (OSError(28, "No space left on device"), "the results cannot be written ([Errno 28] No space left on device)"),
        (MemoryError(), "there is not enough memory"),
        (ValueError("x"), "the recorder failed (ValueError('x')); please report its log"),
    ],
)
def test_nobody_waits_for_a_recorder_that_failed(error: Exception, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever ends a run by hand, the recorder tells the others that it has given up: no launcher ends them."""
    told: list[str] = []

    class FailingDirection:
        def __init__(self, *_: object) -> None:
            pass

        def start(self) -> None:
            raise error

        def dismiss(self) -> None:
            pass

    monkeypatch.setattr(recorder, "Session", lambda *_, **__: nullcontext())
    monkeypatch.setattr(recorder, "Conductor", lambda *_: SimpleNamespace(missing=[], abandon=told.append))
    monkeypatch.setattr(recorder, "Direction", FailingDirection)
    score = SimpleNamespace(scenario=SimpleNamespace(digested=(), relayed=False), end=lambda: None)
    run, brief = SimpleNamespace(score=score), SimpleNamespace(part=SimpleNamespace(recording=False))
    with pytest.raises(type(error)):
        recorder._conduct(run, brief, SimpleNamespace(check=None), None, RunEnd(), by_hand=True)  # type: ignore[arg-type]
    assert [why.startswith(words) for why in told] == [True]


def test_nobody_waits_for_a_recorder_that_fails_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """All slots are done, but the last message of a process breaks the protocol: the others may not have been told to end."""
    told: list[str] = []

    def ends(_: float) -> None:
        raise MalformedMessage("evedrop/r/telemetry/eve", "over = 3", "true", b"", "eve")

    conductor = SimpleNamespace(end=ends, abandon=told.append)
    direction = SimpleNamespace(start=lambda: None, dismiss=lambda: None)
    monkeypatch.setattr(recorder, "Session", lambda *_, **__: nullcontext())
    monkeypatch.setattr(recorder, "Conductor", lambda *_: conductor)
    monkeypatch.setattr(recorder, "Direction", lambda *_: direction)
    monkeypatch.setattr(recorder, "emit", lambda _: None)
    score = SimpleNamespace(scenario=SimpleNamespace(digested=(), relayed=False, slots=1), end=lambda: None)
    rows = SimpleNamespace(save_rows=lambda: None)
    run = SimpleNamespace(score=score, folder=rows, joiner=SimpleNamespace(complete=lambda _: True))
    brief = SimpleNamespace(part=SimpleNamespace(recording=False), flow=SimpleNamespace(longest_outage=1.0))
    end = RunEnd()
    with pytest.raises(MalformedMessage):
        recorder._conduct(run, brief, SimpleNamespace(check=None), None, end, by_hand=True)  # type: ignore[arg-type]
    assert [why.startswith("malformed message on evedrop/r/telemetry/eve") for why in told] == [True]
    assert end.accused == ("eve",)
