"""A quiet wire says nothing but what went wrong."""

from __future__ import annotations

from pathlib import Path
from threading import Event, Thread

from evedrop.wire.file import wire_of
from evedrop.wire.run import run_wire
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import program


def test_a_failed_expectation_is_told_apart_from_the_rest(tmp_path: Path) -> None:
    """The command with `--quiet` prints it on standard error; the exit status is 1."""
    plan = wire_of(
        {
            "side": {"robot": {}, "base": {}},
            "link": [{"from": "robot", "to": "base"}, {"from": "base", "to": "robot"}],
            "expect": [
                {"figure": "robot-base.delivery", "below": 0.5},
                {"figure": "robot-base.delivery", "above": 0.5},
            ],
        }
    )
    said: list[str] = []
    wrong: list[str] = []
    ended = Event()

    def send() -> None:
        wait_until(lambda: any(line.startswith("robot ") for line in said), "the wire's endpoints")
        with program([next(line for line in said if line.startswith("robot ")).split(" ")[1]]) as session:
            while not ended.wait(0.01):
                session.put("scan", b"x")

    sender = Thread(target=send)
    sender.start()
    try:
        assert run_wire(plan, tmp_path / "out", seconds=1.0, say=said.append, complain=wrong.append) == 1
    finally:
        ended.set()
        sender.join(LIMIT)
    assert wrong == ["expected robot-base.delivery below 0.5: FAILED, found 1"]
    assert "expected robot-base.delivery above 0.5: held, found 1" in said
    assert wrong[0] not in said
