"""Monte Carlo: the same results however the work is spread, and every trial the one that runs live."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from scipy.stats import chi2

from evedrop import preloaded
from evedrop.cli.api import montecarlo, run
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.conftest import Evedrop
from tests.examples import mostly_long

CASES: dict[str, dict[str, Any]] = {
    "two blocks and a part": {"trials": 1037, "slots": 50},
    "whole blocks, later trials": {"trials": 1000, "slots": 40, "first_trial": 77, "record_trials": 3},
}
TABLES = ("slots", "trials", "digests")

Study = Callable[[str, int], Results]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A case with a number of workers, run once."""

    @cache
    def made(case: str, workers: int) -> Results:
        out = tmp_path_factory.mktemp("study") / "run"
        return montecarlo("eavesdroppers", out=out, plan=Plan(workers=workers), **CASES[case])

    return made


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("case", "workers"),
    mostly_long(product(CASES, [2, 3]), [("two blocks and a part", 3), ("whole blocks, later trials", 2)]),
)
def test_results_do_not_depend_on_the_number_of_workers(case: str, workers: int, study: Study) -> None:
    """Digests, tables to the last bit, and the whole summary but its times."""
    alone, spread = study(case, 1), study(case, workers)
    for table in TABLES:
        assert getattr(alone, table).equals(getattr(spread, table)), table
    times = {"wall_seconds", "slots_per_second"}
    assert alone.summary.keys() == spread.summary.keys()
    assert {key: value for key, value in alone.summary.items() if key not in times} == {
        key: value for key, value in spread.summary.items() if key not in times
    }
    assert all(peer["digest"] for peer in alone.summary["peers"].values())


def test_later_trials_are_those_of_the_whole(tmp_path: Path, study: Study) -> None:
    """Trials 700 to 719 alone, from the middle of a block, have the digests they have among 1037."""
    few = montecarlo("eavesdroppers", slots=50, trials=20, first_trial=700, out=tmp_path / "few")
    whole = study("two blocks and a part", 1).digests
    some = pc.and_(pc.greater_equal(whole["trial"], 700), pc.less(whole["trial"], 720))
    assert few.digests.num_rows == 20 * 4
    names = ("peer", "trial", "block", "digest")
    rows = [set(zip(*(t[name].to_pylist() for name in names), strict=True)) for t in (few.digests, whole.filter(some))]
    assert rows[0] == rows[1]


def test_the_tables_are_the_means_of_the_trials(tmp_path: Path) -> None:
    """With every trial recorded, means, standard errors and fractions are those of plain numpy."""
    results = montecarlo("eavesdroppers", slots=12, trials=7, record_trials=7, out=tmp_path / "run")
    table = results.trials.to_pydict()
    for row in results.slots.to_pylist():
        mine = [
            i for i, at in enumerate(zip(table["slot"], table["peer"], strict=True)) if at == (row["slot"], row["peer"])
        ]
        errors = np.array([table["squared_error"][i] for i in mine])
        assert len(mine) == row["trials"] == 7
        assert row["mean_squared_error"] == pytest.approx(errors.mean(), rel=1e-12)
        assert row["standard_error"] == pytest.approx(errors.std(ddof=1) / np.sqrt(7), rel=1e-6, abs=1e-18)
        assert row["mean_trace_covariance"] == pytest.approx(np.mean([table["trace_covariance"][i] for i in mine]))
        actions = [table["action"][i] for i in mine]
        assert row["received_fraction"] == pytest.approx(1 - actions.count("dropped") / 7)
        assert row["used_fraction"] == pytest.approx(1 - (actions.count("dropped") + actions.count("discarded")) / 7)


def least_probable(results: Results) -> tuple[tuple[int, str], float, float]:
    """Trial, receiver, expected mean error and probability, from every recorded trial, by textbook formulas."""
    table, probabilities = results.trials.to_pydict(), {}
    columns = (table[name] for name in ("peer", "trial", "action", "trace_covariance", "squared_error"))
    trials: dict[tuple[int, str], list[tuple[str, float, float]]] = {}
    for peer, trial, action, trace, error in zip(*columns, strict=True):
        if peer in {"legitimate", "smart"}:
            trials.setdefault((trial, peer), []).append((action, trace, error))
    for at, rows in trials.items():
        sums = [0.0]
        for action, trace, _ in rows:
            if action == "state":
                sums.append(0.0)
            sums[-1] += trace
        mean, spread = sum(sums), sum(value * value for value in sums)
        if mean > 0.0:
            distribution = chi2(mean**2 / spread, scale=spread / mean)
            error = sum(error for *_, error in rows)
            probabilities[at] = (2.0 * min(distribution.cdf(error), distribution.sf(error)), mean / len(rows))
    least = min(probabilities, key=lambda at: probabilities[at])
    return least, probabilities[least][1], probabilities[least][0]


def test_the_most_surprising_trial_is_the_least_probable_one(tmp_path: Path) -> None:
    """Recomputed from every recorded trial: its error against what its own losses let expect."""
    results = montecarlo("eavesdroppers", slots=30, trials=40, record_trials=40, first_trial=5, out=tmp_path / "run")
    surprising, (at, expected, probability) = results.summary["surprising"], least_probable(results)
    assert at == (surprising["trial"], surprising["receiver"])
    assert surprising["expected_error"] == pytest.approx(expected, rel=1e-9)
    assert surprising["probability"] == pytest.approx(probability, rel=1e-6)
    errors = [row["squared_error"] for row in results.trials.to_pylist() if (row["trial"], row["peer"]) == at]
    assert surprising["mean_error"] == pytest.approx(np.mean(errors), rel=1e-9)


@pytest.mark.long
def test_the_largest_error_is_not_the_most_surprising_trial(tmp_path: Path) -> None:
    """A trial that lost its first packets has an error that is far from the median, and as expected."""
    results = montecarlo("vehicle", slots=200, trials=50, record_trials=50, out=tmp_path / "run")
    surprising, rows = results.summary["surprising"], results.trials.to_pylist()
    errors: dict[int, float] = dict.fromkeys(range(50), 0.0)
    for row in rows:
        if row["peer"] == surprising["receiver"]:
            errors[row["trial"]] += row["squared_error"] / 200
    logarithms = np.log(list(errors.values()))
    assert surprising["trial"] != np.argmax(np.abs(logarithms - np.median(logarithms)))
    assert surprising["trial"] == least_probable(results)[0][0]


@pytest.mark.thorough
@pytest.mark.parametrize("shards", mostly_long([1, 2], [2]))
def test_the_most_surprising_trial_is_the_same_live_and_in_memory(shards: int, tmp_path: Path) -> None:
    """To the bit, for any division of the trials into shards."""
    with preloaded():
        live = run("eavesdroppers", trials=12, slots=70, shards=shards, out=tmp_path / "live")
    memory = montecarlo(live.folder, trials=12, out=tmp_path / "memory")
    assert live.summary["surprising"] == memory.summary["surprising"]


@pytest.mark.parametrize(
    ("name", "mode", "there"),
    [
        ("eavesdroppers", Mode.EXACT, True),
        ("eavesdroppers", Mode.ERROR_COORDINATES, True),
        ("eavesdroppers", Mode.COVARIANCE_ONLY, False),  # its error is its own expectation
        ("heated-room", Mode.EXACT, False),  # inputs and disturbances
        ("acknowledged", Mode.EXACT, False),  # packets that are not states
        ("late", Mode.EXACT, True),  # by the one receiver that uses no late packets
    ],
)
def test_a_trial_surprises_only_where_its_own_expectation_is_known(
    name: str, mode: Mode, there: bool, tmp_path: Path
) -> None:
    """The modes with errors agree; elsewhere the entry is null."""
    plan = Plan(mode, workers=1)
    summary = montecarlo(name, slots=40, trials=15, expect=[], event=[], plan=plan, out=tmp_path / "run").summary
    assert (summary["surprising"] is not None) is there
    if name == "late":
        assert summary["surprising"]["receiver"] == "hasty"
    if mode is Mode.ERROR_COORDINATES:
        exact = montecarlo(name, slots=40, trials=15, expect=[], out=tmp_path / "exact").summary["surprising"]
        assert summary["surprising"].pop("receiver") == exact.pop("receiver")
        assert summary["surprising"] == pytest.approx(exact, rel=1e-6)


@pytest.mark.thorough
def test_the_printed_command_shows_the_surprising_trial_live(evedrop: Evedrop) -> None:
    """It is run as printed, with a folder whose name has a blank in it: same digests, same error, one trial."""
    done = evedrop(
        "montecarlo",
        "eavesdroppers",
        "--slots",
        "300",
        "--trials",
        "30",
        "--record-trials",
        "2",
        "--out",
        "a study",
        "--verbose",
    )
    assert (done.status, done.err) == (0, "")
    study = Results.read(evedrop.folder / "a study")
    surprising = study.summary["surprising"]
    line = next(line for line in done.out.splitlines() if "watch it live: " in line)
    words = shlex.split(line.partition("watch it live: ")[2])
    assert words[0] == "evedrop"
    assert words[-4:] == ["--first-trial", str(surprising["trial"]), "--trials", "1"]
    again = evedrop(*words[1:], "--pace", "0", "--view", "off", "--out", "live")
    assert (again.status in {0, 1}, again.err) == (True, "")  # 1: its error is too large for the scenario's expectation
    live = Results.read(evedrop.folder / "live")
    assert live.summary["mode"] == "live"
    of_trial = study.digests.filter(pc.equal(study.digests["trial"], surprising["trial"])).to_pylist()
    key = lambda row: (row["peer"], row["block"])  # noqa: E731 - once
    assert sorted(live.digests.to_pylist(), key=key) == sorted(of_trial, key=key)
    errors = [row["squared_error"] for row in live.trials.to_pylist() if row["peer"] == surprising["receiver"]]
    assert np.mean(errors) == pytest.approx(surprising["mean_error"], rel=1e-12)
    assert re.search(rf"most surprising: trial {surprising['trial']}, {surprising['receiver']}", done.out)


def test_a_scenario_of_ones_own_runs_with_changes(tmp_path: Path) -> None:
    """From Python, a checked scenario with dotted changes is what the command runs with --set."""
    from evedrop.scenario.loading import load

    ours = montecarlo(load("eavesdroppers"), trials=3, slots=20, legitimate__link__quality=0.5, out=tmp_path / "a")
    named = montecarlo("eavesdroppers", trials=3, slots=20, legitimate__link__quality=0.5, out=tmp_path / "b")
    assert ours.summary["peers"] == named.summary["peers"]


@pytest.mark.parametrize("workers", [0, -1])
def test_no_workers_are_refused(workers: int, tmp_path: Path) -> None:
    """A usage error, and no folder."""
    with pytest.raises(UsageError, match="expected 1 or more"):
        montecarlo("eavesdroppers", trials=3, slots=20, plan=Plan(workers=workers), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_late_packets_count_in_the_slot_in_which_they_arrive(tmp_path: Path) -> None:
    """The fractions of the slots have the mean that the summary states."""
    delay = {"model": "normal", "mean": 1.0, "standard_deviation": 0.7}
    changes: dict[str, Any] = {"legitimate__window": 3, "legitimate__link": {"quality": 0.9, "delay": delay}}
    results = montecarlo("eavesdroppers", slots=30, trials=7, out=tmp_path / "run", **changes)
    assert results.links["legitimate"].late
    rows = [row for row in results.slots.to_pylist() if row["peer"] == "legitimate"]
    for name in ("received_fraction", "used_fraction"):
        assert np.mean([row[name] for row in rows]) == pytest.approx(results.summary["peers"]["legitimate"][name])
