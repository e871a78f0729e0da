"""A quiet wire says nothing but what went wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.wire.file import wire_of
from evedrop.wire.run import run_wire
from tests.wire.wire_at_work import sending


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
