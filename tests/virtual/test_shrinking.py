"""Cases that break a promise become as small as what breaks it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import pytest

from evedrop.cli.simulated import program
from evedrop.live.recorder import run_folder
from evedrop.live.recorder.recovery import Recovery
from evedrop.names import SENSOR
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase, case_from, case_of
from evedrop.virtual.faults import CutConnection, KillProcess, StopProcess
from evedrop.virtual.shrinking import kind_of, shrink

MISS = "trials lacks 3 of 9 rows"


def where(condition: Callable[[SimulatedCase], bool]) -> SimulatedCase:
    """The case of the first seed for which this holds."""
    return next(case for case in map(case_of, range(1, 5000)) if condition(case))


@cache
def large() -> SimulatedCase:
    """A case in which much can be left out."""
    return replace(
        where(
            lambda case: (
                len(case.scenario.eavesdroppers) > 1
                and case.scenario.slots > 20
                and case.scenario.trials > 2
                and case.scenario.controller is not None
                # It learns in slot 40, so that such a run cannot be shorter.
                and all(table.strategy != "replay-informed" for table in case.scenario.eavesdroppers.values())
            )
        ),
        faults=(StopProcess("eve0", 123, 1.234), KillProcess(SENSOR, 2045), CutConnection("legitimate", 60, 0.5)),
    )


def killed_after_five(case: SimulatedCase) -> tuple[str, ...]:
    """A promise that breaks where something is killed in a run of five slots or more."""
    killed = any(isinstance(fault, KillProcess) for fault in case.faults)
    return (MISS,) if killed and case.scenario.slots >= 5 else ()


def test_only_what_breaks_the_promise_is_left() -> None:
    """The fault, the slots, and nothing else."""
    shrunk = shrink(large(), [MISS], killed_after_five)
    scenario = shrunk.case.scenario
    assert [fault.kind for fault in shrunk.case.faults] == ["kill"]
    assert scenario.slots == 5
    assert scenario.trials == 1
    assert not scenario.eavesdroppers
    assert scenario.controller is None
    assert scenario.encoding.spec == {"scheme": "plain"}
    assert scenario.as_tables()["legitimate"] == {"link": {"quality": 1.0}}
    assert shrunk.misses == (MISS,)


def test_what_breaks_the_promise_stays() -> None:
    """Everything that the promise is about."""
    scheme, names = large().scenario.encoding.scheme, set(large().scenario.eavesdroppers)
    strategies = {table.strategy for table in large().scenario.eavesdroppers.values()}

    def play(case: SimulatedCase) -> Sequence[str]:
        tables = case.scenario.eavesdroppers
        same = set(tables) == names and {table.strategy for table in tables.values()} == strategies
        return [MISS] if same and case.scenario.encoding.scheme == scheme and case.faults == large().faults else []

    case = shrink(large(), [MISS], play).case
    assert case.faults == large().faults
    assert set(case.scenario.eavesdroppers) == names
    assert case.scenario.slots == 1


def test_the_same_case_shrinks_to_the_same_case() -> None:
    """Whenever it is shrunk."""
    assert shrink(large(), [MISS], killed_after_five) == shrink(large(), [MISS], killed_after_five)


@pytest.mark.thorough
def test_another_broken_promise_does_not_count() -> None:
    """A smaller case that fails in another way explains nothing."""
    shrunk = shrink(large(), [MISS], lambda case: [MISS] if case.faults == large().faults else ["sensor is left"])
    assert shrunk.case.faults == large().faults


def test_no_more_cases_are_played_than_allowed() -> None:
    """What was found until then breaks the promise."""
    played: list[SimulatedCase] = []

    def play(case: SimulatedCase) -> Sequence[str]:
        played.append(case)
        return killed_after_five(case)

    shrunk = shrink(large(), [MISS], play, most=7)
    assert shrunk.plays == len(played) == 7
    assert killed_after_five(shrunk.case)


def test_no_case_is_played_twice() -> None:
    """Playing takes most of the time."""
    texts: list[str] = []

    def play(case: SimulatedCase) -> Sequence[str]:
        texts.append(case.to_text())
        return killed_after_five(case)

    shrink(large(), [MISS], play)
    assert len(texts) == len(set(texts))


@pytest.mark.campaign
def test_a_smaller_case_that_is_lucky_is_tried_in_other_worlds() -> None:
    """Its interleavings are not those of the case."""
    shrunk = shrink(large(), [MISS], lambda case: [MISS] if case.seed == 2 or case == large() else [])
    assert shrunk.case.seed == 2
    assert shrunk.case.scenario.slots == 1


@pytest.mark.campaign
def test_a_fault_comes_earlier_in_a_shorter_run() -> None:
    """Otherwise it would come after the end."""
    fault = KillProcess("router", 2040)
    case = SimulatedCase(1, large().scenario, (fault,))
    per_slot = fault.after / case.scenario.slots

    def play(smaller: SimulatedCase) -> Sequence[str]:
        return [MISS] if smaller.faults and smaller.faults[0].after <= per_slot * smaller.scenario.slots + 40 else []

    assert shrink(case, [MISS], play).case.scenario.slots == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (
            "trials lacks 33 of 41 rows, such as (8, 'legitimate', 0)",
            "trials lacks 1 of 9 rows, such as (2, 'eve1', 3)",
        ),
        (
            "trials (3, 'eve1', 0): x_hat is [1.0, -2e-05], not [nan, 2.0]",
            "trials (0, 'eve0', 1): x_hat is [0.5], not [1.5]",
        ),
        (
            "the digest of eve0 is 0123456789ab, not aaaaaaaaaaaa",
            "the digest of legitimate is abcdefabcdef, not 111111111111",
        ),
        (
            "status 3: sensor and router: alive, and silent for 36 s (sensor waits on evedrop/r410801f5/control/sensor); see a",
            "status 3: eve1: alive, and silent for 6 s (eve1 waits on evedrop/r303e61cd/downlink/eve1); see b",
        ),
    ],
)
def test_misses_of_one_kind_differ_in_numbers_and_names(one: str, other: str) -> None:
    """And in nothing else."""
    assert kind_of(one) == kind_of(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("trials lacks 33 of 41 rows", "slots lacks 33 of 41 rows"),
        ("the digest of eve0 is 0123456789ab, not aaaaaaaaaaaa", "eve0 is left"),
        ("status 3: eve1: alive, and silent for 6 s", "status 3: eve1: left the network"),
    ],
)
def test_other_misses_are_of_another_kind(one: str, other: str) -> None:
    """So that the test above tests something."""
    assert kind_of(one) != kind_of(other)


def misses_of(case: SimulatedCase) -> Sequence[str]:
    """What a case really breaks."""
    return play_case(case, program).misses


@pytest.mark.campaign
def test_a_recorder_that_forgets_rows_is_shown_by_a_run_without_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even a fault is needed; and the text of the case is enough to play it again, to the same events."""
    case = where(lambda case: case.scenario.slots > 10 and not case.scenario.relayed and not case.faults)

    def forgetful(writer: object, slots: object, scored: object, first_trial: int) -> None:
        """Writes no rows."""

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "write_rows", forgetful)
        misses = misses_of(case)
        assert any("lacks" in miss for miss in misses)
        shrunk = shrink(case, misses, misses_of)
        again = play_case(case_from(shrunk.case.to_text()), program)
        assert again.misses == shrunk.misses
        assert again.run.digest == play_case(shrunk.case, program).run.digest
    scenario = shrunk.case.scenario
    assert (scenario.slots, scenario.trials, scenario.encoding.scheme) == (1, 1, "plain")
    assert not scenario.eavesdroppers
    assert misses_of(shrunk.case) == ()


@pytest.mark.long
def test_a_recorder_that_never_asks_again_is_shown_by_one_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process is cut off before it has reported."""
    case = where(
        lambda case: (
            case.scenario.encoding.scheme == "random-code"
            and len(case.scenario.eavesdroppers) > 1
            and case.scenario.shards == 1
            and case.scenario.controller is None
        )
    )
    cuts = (
        SimulatedCase(case.seed, case.scenario, (CutConnection("eve1", after, 1.0), KillProcess("launcher", 10**6)))
        for after in range(50, 90)
    )
    monkeypatch.setattr(Recovery, "_round", lambda *_: None)
    failing, misses = next((cut, found) for cut in cuts if (found := misses_of(cut)))
    shrunk = shrink(failing, misses, misses_of, most=20)
    assert [fault.kind for fault in shrunk.case.faults] == ["cut"]
    assert list(shrunk.case.scenario.eavesdroppers) == ["eve1"]
    monkeypatch.undo()
    assert misses_of(shrunk.case) == ()
