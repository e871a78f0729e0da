"""Liveliness crosses a wire and is never lost."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh

from tests.conftest import wait_until
from tests.wire.wire_at_work import DEAD, at_work, both_ways, link, plan_of


def alive(session: zenoh.Session, key: str = "**") -> list[str]:
    """The tokens that a program sees."""
    return sorted(
        {str(reply.ok.key_expr) for reply in session.liveliness().get(key, timeout=5.0) if reply.ok is not None}
    )


@pytest.mark.parametrize("key", ["fleet/1", "@ros2_lv/0/abc/0/0/NN/%/%/talker"])
def test_a_token_crosses_with_its_history_and_goes_with_its_program(tmp_path: Path, key: str) -> None:
    """Even over links that lose everything, and to programs that come later."""
    with at_work(both_ways(DEAD, DEAD), tmp_path) as wire, wire.program("base") as watcher:
        seen: list[tuple[str, bool]] = []
        expression = key.split("/", maxsplit=1)[0] + "/**"
        watcher.liveliness().declare_subscriber(
            expression, lambda sample: seen.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        )
        with wire.program("robot") as robot:
            token = robot.liveliness().declare_token(key)  # it lives as long as the object
            wait_until(lambda: seen == [(key, True)], "the token appears")
            with wire.program("base") as late:
                assert alive(late, expression) == [key]
                history: list[str] = []
                late.liveliness().declare_subscriber(
                    expression, lambda sample: history.append(str(sample.key_expr)), history=True
                )
                wait_until(lambda: history == [key], "its history is there")
        wait_until(lambda: seen == [(key, True), (key, False)], "the token vanishes with its program")
        del token


def test_a_tap_shows_tokens_and_hides_the_listener(tmp_path: Path) -> None:
    """A listener is not seen by those it listens to."""
    plan = plan_of(link("robot", "base"), link("robot", "listener", tap=True))
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot") as robot,
        wire.program("base") as base,
        wire.program("listener") as listener,
    ):
        programs = {"robot": robot, "base": base, "listener": listener}
        tokens = [program.liveliness().declare_token(name) for name, program in programs.items()]
        wait_until(lambda: alive(robot) == ["base", "robot"], "the base's token crosses against its link")
        wait_until(lambda: alive(listener) == ["listener", "robot"], "the listener sees the robot")
        wait_until(lambda: alive(base) == ["base", "robot"], "the base sees the robot")
        del tokens


def test_a_token_of_a_program_that_is_killed_vanishes(tmp_path: Path) -> None:
    """A closed session stands for it: its transport is gone."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("base") as watcher:
        robot = wire.program("robot")
        token = robot.liveliness().declare_token("x")
        wait_until(lambda: alive(watcher) == ["x"], "it is there")
        robot.close()
        wait_until(lambda: not alive(watcher), "it is gone")
        del token
