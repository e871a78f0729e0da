"""Arguments of the wrong type are refused by name, before anything is computed or removed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evedrop import Scenario, compare, cost, design, load_results, montecarlo, run, sweep
from evedrop.cli.api import RunResults, design_budget, design_policy, design_schedule
from evedrop.errors import UnknownName, UsageError
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.builders import GOOD

SMALL = Scenario(GOOD).replace(slots=12)
A_SCENARIO = "expected a built-in name, a file, or a Scenario"
A_GRID = "expected a dict of lists by dotted key"


@pytest.fixture(scope="module")
def results() -> RunResults:
    """A small study."""
    return montecarlo(SMALL, trials=2)


@pytest.mark.parametrize(
    ("call", "arguments", "options", "message"),
    [
        (montecarlo, [{"slots": 3}], {}, rf"scenario=\{{'slots': 3\}}: {A_SCENARIO}"),
        (montecarlo, [None], {}, f"scenario=None: {A_SCENARIO}"),
        (run, [3], {}, f"scenario=3: {A_SCENARIO}"),
        (design, [b"vehicle"], {}, f"scenario=b'vehicle': {A_SCENARIO}"),
        (sweep, [["a"], {"slots": [1, 2]}], {}, A_SCENARIO),
        (compare, [["a"]], {}, A_SCENARIO),
        (Scenario.load, [{}], {}, A_SCENARIO),
        (sweep, [SMALL, [1, 2]], {}, rf"over=\[1, 2\]: {A_GRID}"),
        (sweep, [SMALL, None], {}, f"over=None: {A_GRID}"),
        (sweep, [SMALL, "slots"], {}, f"over='slots': {A_GRID}"),
        (sweep, [SMALL, {3: [1, 2]}], {}, A_GRID),
        (montecarlo, [SMALL], {"out": 3}, "out=3: expected the name of a folder"),
        (montecarlo, [SMALL], {"out": 3, "resume": True}, "out=3: expected the name of a folder"),
        (cost, ["microgrid"], {"out": 3}, "out=3: expected the name of a folder"),
        (montecarlo, [SMALL], {"out": b"x"}, "out=b'x': expected the name of a folder"),
        (montecarlo, [SMALL], {"out": "x", "overwrite": "no"}, "overwrite='no': expected True or False"),
        (montecarlo, [SMALL], {"workers": "2"}, "workers='2': expected a whole number"),
        (montecarlo, [SMALL], {"workers": 1.5}, "workers=1.5: expected a whole number"),
        (montecarlo, [SMALL], {"workers": True}, "workers=True: expected a whole number"),
        (montecarlo, [SMALL], {"plan": "exact"}, "plan='exact': expected a Plan"),
        (montecarlo, [SMALL], {"plan": {}}, r"plan=\{\}: expected a Plan"),
        (montecarlo, [SMALL], {"on_event": 3}, "on_event=3: expected a function"),
        (Plan, [], {"mode": "fast"}, "mode='fast': expected exact, error-coordinates or covariance-only"),
        (run, [SMALL], {"listen": 7447}, "listen=7447: expected an endpoint"),
        (load_results, [3], {}, "folder=3: expected the results folder"),
        (Scenario, [3], {}, "entries=3: expected a dict of entries"),
        (
            Scenario,
            ["vehicle"],
            {},
            r"entries='vehicle': expected a dict of entries; Scenario.load\(\"vehicle\"\) reads",
        ),
        (SMALL.replace, ["slots=3"], {}, "changes='slots=3': expected a dict by dotted key"),
        (SMALL.replace, [{3: 4}], {}, "expected a dict by dotted key"),
        (Scenario.load, ["vehicle", "slots=3"], {}, "changes='slots=3': expected a dict by dotted key"),
        (design, ["vehicle"], {"changes": "slots=3"}, "changes='slots=3': expected a dict by dotted key"),
        (design, ["vehicle"], {"max_trace": "5"}, "max_trace='5': expected a number"),
        (design, ["vehicle"], {"min_ratio": "10"}, "min_ratio='10': expected a number"),
        (design_schedule, ["vehicle", "ten"], {"max_trace": 5.0}, "slots='ten': expected a whole number"),
        (design_schedule, ["vehicle", 10], {"max_trace": 5.0, "block": 1.5}, "block=1.5: expected a whole number"),
        (design_policy, ["acknowledged"], {"weights": 3}, "weights=3: expected a list of numbers"),
        (design_policy, ["acknowledged"], {"prices": ["x"]}, "prices='x': expected a number"),
        (design_policy, ["acknowledged"], {"weights": []}, r"weights=\[\]: expected a list of numbers, at least one"),
        (design_policy, ["acknowledged"], {"states": 2.5}, "states=2.5: expected a whole number"),
        (design_budget, ["vehicle", "x"], {}, "budget='x': expected a number"),
        (compare, [SMALL], {"schemes": "innovation"}, "schemes='innovation': expected a list"),
        (compare, [SMALL], {"adversaries": 3}, "adversaries=3: expected a list"),
        (compare, [SMALL], {"parameters": [1]}, r"parameters=\[1\]: expected a dict"),
    ],
)
def test_an_argument_of_the_wrong_type_is_refused(
    call: Callable[..., Any],
    arguments: list[Any],
    options: dict[str, Any],
    message: str,
    tmp_path: Path,
    monkeypatch: Any,
) -> None:
    """The message names the argument, its value and what would do; they used to be errors of Python's own, deep inside."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=message):
        call(*arguments, **options)
    assert [*tmp_path.iterdir()] == []


def test_a_picture_is_of_a_range_of_slots(results: RunResults) -> None:
    """A list or a number is refused."""
    for slots in (3, [1, 2]):
        with pytest.raises(UsageError, match="expected a range of slots"):
            results.plot(slots=slots)  # type: ignore[arg-type]


def test_a_panel_is_a_name(results: RunResults) -> None:
    """A list of them is refused as any other word is."""
    with pytest.raises(UsageError, match=r"there is no panel \['errors'\]; expected "):
        results.plot(["errors"])  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"width=\['page'\]: expected"):
        results.plot(width=["page"])  # type: ignore[arg-type]


def test_a_metric_that_there_is_not_is_an_error(results: RunResults) -> None:
    """It used to be None, which is what a metric without a value is."""
    peer = results.peers["smart"]
    assert peer.metric("mean_squared_error") == peer.mean_squared_error
    with pytest.raises(UnknownName, match="there is no metric 'mse'; expected one of mean_squared_error"):
        peer.metric("mse")


def test_a_mode_may_be_given_by_its_name() -> None:
    """As the command line gives it."""
    assert Plan(mode="covariance-only").mode is Mode.COVARIANCE_ONLY  # type: ignore[arg-type]
    assert Plan().mode is Mode.EXACT
