"""A quiet wire says nothing but what went wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.errors import RunError
from evedrop.wire.file import wire_of
from evedrop.wire.publications import PublicationRelay
from evedrop.wire.run import run_wire
from tests.wire.wire_at_work import both_ways, sending


@pytest.mark.thorough
def test_a_failed_expectation_is_told_apart_from_the_rest(tmp_path: Path) -> None:
    """The command with `--quiet` prints it on standard error; the exit status is 1."""
    plan = wire_of(
        {
            "side": {"robot": {}, "base": {}},
            "link": [{"from": "robot", "to": "base"}, {"from": "base", "to": "robot"}],
            "expect": [
                {"metric": "robot-base.delivery", "below": 0.5},
                {"metric": "robot-base.delivery", "above": 0.5},
            ],
        }
    )
    messages: list[str] = []
    wrong: list[str] = []
    with sending(messages):
        assert run_wire(plan, tmp_path / "out", seconds=1.0, say=messages.append, complain=wrong.append) == 1
    assert wrong == ["expected robot-base.delivery below 0.5: FAILED, found 1"]
    assert "expected robot-base.delivery above 0.5: held, found 1" in messages
    assert wrong[0] not in messages


def test_a_wire_over_which_messages_no_longer_cross_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The wire says so at once, and again at its end, which has the status of a failed run."""
    monkeypatch.setattr(PublicationRelay, "_take_all", lambda *_: 1 / 0)
    said: list[str] = []
    why = r"messages from the side robot no longer cross \(ZeroDivisionError.*the side base no longer cross"
    with pytest.raises(RunError, match=why):
        run_wire(both_ways(), tmp_path / "out", seconds=0.0, say=said.append)
    assert capsys.readouterr().err.count("no longer cross") >= 2
    assert said[-1] == f"results: {tmp_path / 'out'}"
