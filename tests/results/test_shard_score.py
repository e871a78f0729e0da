"""The tally of a shard is data: it comes back as it was stored, and bytes in the file decide values, never which code runs."""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.errors import RunError, ScenarioError, UsageError
from evedrop.results.shard_score import NotData, dump_score, load_score, packed, unpacked
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.scenarios import shipped
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.simulate.montecarlo import check_mode
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of


class Evil:
    """An object that runs a command where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return os.mkdir, (str(self.path),)


def short(name: str) -> Scenario:
    """A shipped scenario, with few slots and trials."""
    return load(name, {"slots": 12, "trials": 5, "record_trials": 1, "expect": []})


@pytest.mark.parametrize("name", ["eavesdroppers", "microgrid", "measured", "acknowledged"])
def test_totals_come_back(name: str, tmp_path: Path) -> None:
    """With a controller, an application, a filter, acknowledgements; the file is private, and an empty folder has no tally."""
    scenario = short(name)
    (task,) = tasks_of(scenario, Mode.EXACT, 1)
    run_tally = task.carry_out(lambda _: None, lambda: False).blocks[0].run_tally
    dump_score(run_tally, tmp_path, scenario)
    (file,) = tmp_path.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert packed(load_score(tmp_path, scenario)) == packed(run_tally)
    assert packed(load_score(tmp_path / "none", scenario)) == packed(RunTally.nothing(scenario, 5))


def test_a_digest_is_that_of_all_trials_or_none(tmp_path: Path) -> None:
    """An application has no digest if another shard has stored nothing. Its means are those of the trials that are there."""
    scenario = load("replay-attack", {"slots": 12, "trials": 5, "expect": [], "event": [], "integrity.attack": None})
    (task,) = tasks_of(scenario, Mode.EXACT, 1)
    run_tally = task.carry_out(lambda _: None, lambda: False).blocks[0].run_tally
    twice = scenario.model_copy(update={"trials": 10})
    entries = []
    for other in (run_tally, load_score(tmp_path, scenario)):
        both = RunTally.merged([run_tally, other])
        summary = summary_of(twice, both, dict.fromkeys(scenario.digested), RunOutcome(0.0))
        entries.append(summary.applications["integrity"])
    assert entries[0]["digest"]
    assert entries[1]["digest"] is None
    assert entries[1]["watermark_cost"] == pytest.approx(entries[0]["watermark_cost"])


def test_a_file_of_somebody_else_runs_nothing(tmp_path: Path) -> None:
    """A pickle is refused in a sentence, as are bytes without a tally."""
    scenario = short("eavesdroppers")
    for content in (pickle.dumps(Evil(tmp_path / "ran")), b"", packed(5), packed([1])):
        (tmp_path / "score").write_bytes(content)
        with pytest.raises(RunError, match=r"score is damaged \(.*run again"):
            load_score(tmp_path, scenario)
    assert not (tmp_path / "ran").exists()


class Place(NamedTuple):
    """A tuple of a class."""

    x: int
    y: float


@dataclass(frozen=True)
class Inner:
    """An instance in an instance."""

    values: Any = None


@dataclass
class Outer:
    """Everything that a result may have."""

    one: Any = 1
    inner: Inner = field(default_factory=Inner)
    table: dict[Any, Any] = field(default_factory=lambda: {Place(1, 2.0): Inner()})
    parts: list[Inner] = field(default_factory=lambda: [Inner()])
    act: Any = len


def test_instances_come_back() -> None:
    """Numbers to the bit, arrays with their kinds, tuples and names of classes, and functions of the example."""
    array = np.array([[0.1, -0.0], [math.inf, math.nan]])
    value = Outer((None, True, -(2**63), 1e-300, "μ", b"\0"), Inner(array), {Place(1, 2.0): Inner(Place(3, 4.0))})
    value.parts = [Inner({"a", "b"}), Inner(np.float32(0.1)), Inner(np.zeros((0, 3), np.uint16))]
    back: Outer = unpacked(packed(value), Outer())
    assert (back.one, back.act) == (value.one, len)
    assert back.inner.values.tobytes() == array.tobytes()
    assert [type(name) for name in back.table] == [Place]
    assert back.table[Place(1, 2.0)].values == (3, 4.0)
    assert [type(part) for part in back.parts] == [Inner] * 3
    assert back.parts[1].values.dtype == np.float32
    assert (back.parts[2].values.shape, back.parts[2].values.dtype) == ((0, 3), np.uint16)
    back.inner.values[0, 0] = 2.0  # an array of its own


@pytest.mark.parametrize(
    "value", [object, lambda: 1, np.array([object()], object), open], ids=["class", "function", "objects", "built-in"]
)
def test_what_is_not_data_is_refused(value: object) -> None:
    """Classes, arrays of objects; a function is only a place that the example fills."""
    try:
        data = packed(value)
    except NotData:
        return
    with pytest.raises(NotData, match="a function where the example has none"):
        unpacked(data, None)


def test_bytes_name_no_class() -> None:
    """An instance where the example has a number is refused, and no bytes contain the name of a class."""
    data = packed(Outer())
    assert b"Outer" not in data
    assert b"Inner" not in data
    others: tuple[object, ...] = (None, 1, [], {}, np.zeros(2))
    for like in others:
        with pytest.raises(NotData, match="an instance where the example has none"):
            unpacked(data, like)


@given(st.binary(max_size=200), st.integers(0, 10_000))
def test_any_bytes_are_read_or_refused(noise: bytes, place: int) -> None:
    """Bytes that are damaged anywhere give a value or NotData, and no other error."""
    data = bytearray(packed(Outer(np.arange(3), Inner([1.5]))))
    data[place % len(data)] ^= 1 + place % 255
    for data_ in (noise, bytes(data), bytes(data[: place % len(data)])):
        with contextlib.suppress(NotData):
            unpacked(data_, Outer())


SHORT = {"slots": 12, "trials": 503, "record_trials": 2, "expect": []}


@pytest.mark.parametrize("name", [name for name in shipped() if name != "microgrid-mpc"])
def test_every_shipped_scenario_s_results_are_data(name: str) -> None:
    """What a task finds comes back the same, in every mode that the scenario allows."""
    try:
        scenario = load(name, SHORT, beyond_horizon=True)
    except ScenarioError:  # its events need its own slots
        scenario = load(name, {"trials": 2, "record_trials": 1}, beyond_horizon=True)
    for mode in Mode:
        try:
            check_mode(scenario, mode)
        except UsageError:
            continue
        (task,) = tasks_of(scenario, mode, 1)
        result = task.carry_out(lambda _: None, lambda: False)
        assert result.complete
        data = packed(result)
        back = unpacked(data, task.example())
        assert packed(back) == data
