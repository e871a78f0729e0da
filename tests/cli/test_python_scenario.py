"""Scenarios that are made in Python are those of files: equal, with the same messages, and with the same digests."""

from __future__ import annotations

import importlib
import pickle
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import Scenario, montecarlo, sweep
from evedrop.errors import ScenarioError, UsageError
from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.model.schemes.innovation import Innovation
from evedrop.scenario.loading import load, parse, prepared, tables_in, with_event
from evedrop.scenario.tables import ScenarioEntries
from evedrop.scenarios import shipped
from evedrop.simulate.montecarlo import Plan
from evedrop.wire.file import example_wire, wire_of
from evedrop.wire.timeline import with_change
from tests.builders import GOOD, digests_of, mistakes_in_good
from tests.scenario.conformance.own_classes import BLOCK, TEXT


def vehicle(**others: Any) -> Scenario:
    """The good scenario from numpy arrays."""
    process = {name: np.array(rows) for name, rows in GOOD["process"].items()}
    return Scenario({**GOOD, "process": process, **others})


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Any]:
    """The module `flipped` of the tutorial, imported from a folder as a user does."""
    blocks = dict(BLOCK.findall(TEXT))
    (tmp_path / "flipped.py").write_text(blocks["flipped.py"])
    sys.path.insert(0, str(tmp_path))
    yield importlib.import_module("flipped")
    sys.path.remove(str(tmp_path))
    del sys.modules["flipped"]


def test_numpy_arrays_tuples_and_classes_are_what_a_file_says(tmp_path: Path) -> None:
    """An equal scenario, whose text gives an equal one again; it can be pickled."""
    made = Scenario(
        title="A vehicle",
        slots=int(np.int64(50)),
        process={"A": ((1, 0.1), (0, 1)), "Q": np.diag([1e-3, 1e-3]), "initial_covariance": np.eye(2, dtype=np.int64)},
        encoding={"scheme": Innovation, "state_probability": np.float64(0.5)},
        legitimate={"link": {"quality": 0.9}},
        eavesdroppers={"smart": {"strategy": "smart", "link": {"quality": 0.8}}},
    )
    file = tmp_path / "vehicle.toml"
    file.write_text(made.to_toml(), encoding="utf-8")
    assert made == vehicle() == load(file) == pickle.loads(pickle.dumps(made))  # noqa: S301 - as workers do
    assert made != made.replace(seed=1)
    assert made.replace(eavesdroppers__smart__strategy=Naive).eavesdroppers["smart"].strategy == "naive"


LARGE = ("microgrid", "microgrid-mpc")  # whose texts have the disturbances of 86 400 slots


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name in LARGE else name for name in shipped()]
)
def test_every_built_in_scenario_comes_back_from_its_text(name: str, tmp_path: Path) -> None:
    """`Scenario.load`, `to_toml` and back: an equal scenario."""
    made = Scenario.load(name)
    (tmp_path / "again.toml").write_text(made.to_toml(), encoding="utf-8")
    assert Scenario.load(tmp_path / "again.toml") == made == load(name, beyond_horizon=True)


def test_a_scenario_from_python_has_the_digests_of_its_file(tmp_path: Path) -> None:
    """Changes by keyword, by dotted key and in a call are the same; so is the file that `to_toml` writes."""
    plan = Plan(workers=1)
    made = vehicle().replace({"eavesdroppers.smart.link.quality": 0.4}, slots=30)
    (tmp_path / "s.toml").write_text(made.to_toml(), encoding="utf-8")
    results = [
        montecarlo(made, trials=3, out=tmp_path / "python", plan=plan),
        montecarlo(tmp_path / "s.toml", trials=3, out=tmp_path / "file", plan=plan),
        montecarlo(
            vehicle(), trials=3, slots=30, eavesdroppers__smart__link__quality=0.4, out=tmp_path / "c", plan=plan
        ),
    ]
    assert digests_of(results[0]) == digests_of(results[1]) == digests_of(results[2])
    assert Scenario.load(tmp_path / "python").replace(trials=1) == made.replace(trials=1)


@pytest.mark.parametrize(
    "changes",
    [
        {"slots": 0},
        {"process.A": [[1.0, 0.1]]},
        {"slotz": 3},
        {"encoding.scheme": "inovation"},
        {"eavesdroppers.smart.link.quality": 2.0},
        {"event": [{"at": 900, "cut": "legitimate"}]},
        {"expect": [{"metric": "nobody.mean_squared_error", "below": 1.0}]},
    ],
)
def test_a_mistake_is_told_as_for_a_file(changes: dict[str, Any]) -> None:
    """All mistakes at once, each with its key; also those that show only when tables are compared."""
    with pytest.raises(ScenarioError) as caught:
        vehicle().replace(changes)
    assert caught.value.mistakes == mistakes_in_good(changes)


def test_all_mistakes_of_a_new_scenario_are_told_at_once() -> None:
    """Missing entries are named, and a misspelt one gets a hint."""
    with pytest.raises(ScenarioError) as caught:
        Scenario({"title": "x", "slotz": 3})
    mistakes = caught.value.mistakes
    assert [line.partition(":")[0] for line in mistakes] == ["slots", "process", "encoding", "legitimate", "slotz"]
    assert mistakes[-1] == "slotz: is not an entry of this table; did you mean slots?"


@pytest.mark.parametrize(
    "call",
    [
        lambda: Scenario({"slots": "x"}),
        lambda: vehicle(slots=0),
        lambda: vehicle().replace(slots=0),
        lambda: Scenario.load("vehicle", {"slots": 0}),
        lambda: montecarlo("vehicle", legitimate__link__quality=2),
        lambda: parse("slots = 1\nslots = 2\n", "mine.toml"),
        lambda: parse("slots = 0\n", "mine.toml"),
        lambda: with_event(vehicle(), {"cut": "nobody"}, 3),
        lambda: wire_of({"side": 3}),
        lambda: with_change(wire_of(tables_in(example_wire(), "wire")), {"cut": 3}, 1.0),
    ],
)
def test_a_refusal_shows_no_error_of_another_package(call: Callable[[], object]) -> None:
    """The mistakes are told in our words; a traceback with pydantic's words before them, and its address, only hides them."""
    with pytest.raises(ScenarioError) as refused:
        call()
    shown = "".join(traceback.format_exception(refused.value))
    assert "pydantic" not in shown
    assert "another exception" not in shown
    assert "direct cause" not in shown


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.eye(2) * 1j, "process.A: is a numpy.ndarray of complex128; expected a number, "),
        ({1.0}, "process.A: is a set; expected a number, a text, a list, a dict, a numpy array of numbers, or a class"),
        (b"", "process.A: is a bytes; expected a number, "),
    ],
)
def test_values_that_no_file_can_have_are_refused_with_their_key(value: object, message: str) -> None:
    """Nothing is guessed."""
    with pytest.raises(ScenarioError, match=re.escape(message)):
        vehicle(process={**GOOD["process"], "A": value})


def test_none_removes_an_entry() -> None:
    """Of a scenario, of a table in it, or of one that was not there."""
    made = vehicle(energy={"packet": 2.0, "bit": 1.0})
    assert made.replace(energy=None, plant=None, network__routers=None) == vehicle()
    assert made.replace(energy__bit=None) == vehicle(energy={"packet": 2.0})
    loaded = Scenario.load("vehicle", {"expect": None}, eavesdroppers=None, process__units=None)
    assert loaded == Scenario.load("vehicle").replace(expect=None, eavesdroppers=None, process__units=None)
    assert [*loaded.receivers] == ["legitimate"]
    assert [*prepared("vehicle", {"eavesdroppers.naive": None}).eavesdroppers] == ["suspicious", "smart"]


def test_none_removes_entries_of_lists_too() -> None:
    """By their numbers, which are those before any is removed; what is not there needs no removing."""
    kill = {"from": 5, "to": 8, "kill": "smart", "state": "last"}
    scenario = vehicle(event=[kill, *({"at": at, "note": "a word"} for at in range(10, 35, 5))])
    keys = ["event.1", "event.3", "event.7", "event.x", "event.2.at.x", "event.0.state"]
    fewer = scenario.replace(dict.fromkeys(keys))
    assert [event.first for event in fewer.event] == [5, 15, 25, 30]
    assert fewer.event[0] == vehicle(event=[{**kill, "state": None}]).event[0]


def test_an_event_is_added_on_a_host_without_the_secret(tmp_path: Path) -> None:
    """The recorder of an operator's run needs no secret; the scenario still names its file."""
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(32))
    scenario = vehicle(secret_file=secret)
    made = with_event(scenario, {"cut": "smart"}, 3)
    assert made == scenario.replace(event=[{"at": 3, "cut": "smart"}])
    secret.unlink()
    assert with_event(scenario, {"cut": "smart"}, 3) == made
    assert f'secret_file = "{secret}"' in made.to_toml()


def test_all_changes_number_the_entries_of_lists_as_before(tmp_path: Path) -> None:
    """Whether others are removed, changed, replaced or added by the same call; one that is removed and given is new."""
    scenario = vehicle(event=[{"at": at, "note": "a word"} for at in range(10, 35, 5)])
    file = tmp_path / "scenario.toml"
    file.write_text(scenario.to_toml())
    changes = {
        "event.0": None,
        "event.1.at": 16,
        "event.2": {"at": 21, "note": "x"},
        "event.5": {"at": 35, "note": "x"},
    }
    again = {"event.3": None, "event.3.at": 40, "event.3.note": "x"}
    for changed in (scenario.replace(changes | again), Scenario.load(file, again | changes)):
        assert [event.first for event in changed.event] == [16, 21, 40, 30, 35]
    with pytest.raises(ScenarioError, match=r"event\.0\.at") as raised:
        Scenario.load(file, {"event.0": None, "event.1.at": -1})
    assert "line" not in str(raised.value)


@pytest.mark.thorough
def test_a_class_of_a_module_is_named_and_its_folder_known(own: Any, tmp_path: Path) -> None:
    """Worker processes import it from there: the same digests as in this process, and as by name."""
    made = vehicle(encoding={"scheme": own.Flipped}, eavesdroppers={})
    assert made.encoding.scheme == "flipped:Flipped"
    assert made.modules == str(tmp_path)
    assert made == vehicle().replace(encoding={"scheme": own.Flipped}, eavesdroppers=None)
    many = made.replace(slots=2)
    results = [montecarlo(many, trials=501, out=tmp_path / f"{n}", plan=Plan(workers=n)) for n in (1, 2)]
    assert digests_of(results[0]) == digests_of(results[1])


def test_a_sweep_knows_the_folder_of_the_classes_in_it(
    own: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers import them from there; a scenario or a call with modules elsewhere is refused."""
    over = {"encoding": [{"scheme": own.Flipped}, {"scheme": "plain"}]}
    (tmp_path / "other").mkdir()
    elsewhere = str(tmp_path / "other")
    cases: list[tuple[Scenario, dict[str, Any]]] = [
        (vehicle(modules=elsewhere), {}),
        (vehicle(), {"modules": elsewhere}),
    ]
    for scenario, changes in cases:
        with pytest.raises(ScenarioError, match="of several folders"):
            sweep(scenario, over, **changes)

    def stopped(_: object, given: dict[str, Any], values: dict[str, Any], *rest: object, **options: object) -> None:
        raise UsageError(f"{given['modules']} {values['encoding'][0]['scheme']}, {len(rest)} others")

    monkeypatch.setattr("evedrop.studies.sweep.sweep_over", stopped)
    with pytest.raises(UsageError, match=re.escape(f"{tmp_path} flipped:Flipped, ")):
        sweep(vehicle(), over)


def test_classes_of_two_folders_are_refused(own: Any, tmp_path: Path) -> None:
    """The processes of a run look for modules in one folder only."""
    (tmp_path / "other").mkdir()
    with pytest.raises(ScenarioError, match=r"of several folders, .*other and .*; put the modules into one folder"):
        vehicle(encoding={"scheme": own.Flipped}, modules=str(tmp_path / "other"))


def test_a_class_that_no_process_can_import_is_refused_with_the_way_out(own: Any) -> None:
    """Classes of a notebook's cell, of a function, and of a module that was loaded again are refused."""

    class Inside(Innovation):
        pass

    cell = type("Cell", (Innovation,), {"__module__": "__main__"})
    with pytest.raises(ScenarioError, match=r"encoding.scheme: is the class Cell of a notebook .*%%writefile mine.py"):
        vehicle(encoding={"scheme": cell})
    with pytest.raises(
        ScenarioError, match=r"the class Inside of .*test_python_scenario,.* define it at the top level"
    ):
        vehicle(encoding={"scheme": Inside})
    before = own.Flipped
    importlib.reload(own)
    with pytest.raises(ScenarioError, match="is the class Flipped of flipped, which"):
        vehicle(encoding={"scheme": before})


def test_editors_know_every_entry() -> None:
    """The types of the arguments are written down apart from the fields."""
    assert set(ScenarioEntries.__annotations__) == set(Scenario.model_fields) - {"made_with"}


def test_the_class_alone_says_where_scenarios_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without `evedrop.scenario.loading`, which checks whole scenarios, no scenario is made."""
    monkeypatch.setattr(Scenario, "builders", None)
    with pytest.raises(UsageError, match="from evedrop import Scenario"):
        vehicle()
