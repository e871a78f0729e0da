"""Metrics of installed packages: the one in docs/your-own/metric.md in every kind of run, and metrics that fail."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evedrop.model.metrics import METRICS, metric, metrics_of
from evedrop.model.metrics.metric import ScoredSlots
from evedrop.results.reading import Results
from tests.conftest import Evedrop
from tests.packages import install

DOCS = Path(__file__).parents[3] / "docs"
RUN = ("--slots", "20", "--trials", "510")
EXPECT = (
    "--set", "expect.0={metric = 'smart.largest_error', above = 0.0}",
    "--set", "expect.1={metric = 'smart.largest_error', below = 0.0, slots = [5, 15]}",
    "--set", "expect.2={metric = 'smart.largest_error', above = 0.0, quantile = 0.5}",
)  # fmt: skip


def installed(evedrop: Evedrop, module: str, name: str = "largest_error") -> dict[str, str]:
    """The environment in which a package that has this module adds a metric by its metadata."""
    install(evedrop.folder, {"largest.py": module}, {"evedrop.metrics": {name: "largest:LargestError"}})
    return {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}


def of_the_docs() -> str:
    """The module of docs/your-own/metric.md."""
    return (
        (DOCS / "your-own" / "metric.md").read_text(encoding="utf-8").partition("# largest.py\n")[2].partition("```")[0]
    )


@pytest.mark.long
def test_a_metric_of_a_package_needs_nothing_here(evedrop: Evedrop) -> None:
    """One file and one line of metadata: the same number live, in memory with two workers, and in shards; judged and shown."""
    environment = installed(evedrop, of_the_docs())
    runs = {
        "live": ("run", "eavesdroppers", "--view", "off", *RUN),
        "memory": ("montecarlo", "eavesdroppers", "--workers", "2", "--record-trials", "510", *RUN),
        "shards": ("run", "eavesdroppers", "--view", "off", "--set", "shards=2", *RUN),
    }
    largest, judged = {}, {}
    for name, arguments in runs.items():
        done = evedrop.process(*arguments, *EXPECT, "--out", name, env=environment)
        assert done.status == 1, done.err
        assert "largest |x−x̂|²" in done.out
        summary = Results.read(evedrop.folder / name).summary
        largest[name] = {receiver: peer["largest_error"] for receiver, peer in summary["peers"].items()}
        judged[name] = [(expectation["held"], expectation["value"]) for expectation in summary["expectations"]]
    assert largest["live"] == largest["memory"] == largest["shards"]
    assert judged["live"] == judged["memory"] == judged["shards"]
    rows = [row for row in Results.read(evedrop.folder / "memory").trials.to_pylist() if row["peer"] == "smart"]
    errors = np.empty((20, 510))
    for row in rows:
        errors[row["slot"], row["trial"]] = row["squared_error"]
    assert largest["live"]["smart"] == errors.max()
    assert judged["live"] == [
        (True, errors.max()), (False, errors[5:15].max()), (True, np.quantile(errors.max(axis=0), 0.5)),
    ]  # fmt: skip
    done = evedrop.process(
        "sweep", "eavesdroppers", "--over", "slots=10,20", "--trials", "510", "--out", "swept", env=environment
    )
    assert done.status == 0, done.err
    assert "largest error" in done.out
    table = pq.read_table(evedrop.folder / "swept" / "sweep.parquet").to_pylist()
    assert {row["peer"]: row["largest_error"] for row in table if row["slots"] == 20} == largest["memory"]
    assert "largest_error" not in METRICS.names


@pytest.mark.long
def test_a_tally_that_is_not_data_fails_alone_in_shards(evedrop: Evedrop) -> None:
    """An instance where a new tally has none could be of any class; the run and its other metrics are not concerned."""
    becomes = "    def add(self, slots):\n        self.last = type('Last', (), {})()\n        self.last.k = 1\n"
    module = of_the_docs().replace("    def add(self, slots):\n", becomes)
    module = module.replace(
        "    def __init__(self, trials):\n", "    def __init__(self, trials):\n        self.last = None\n"
    )
    run = ("run", "eavesdroppers", "--view", "off", "--set", "shards=2", "--json", *RUN)
    done = evedrop.process(*run, "--out", "shards", env=installed(evedrop, module))
    assert done.status == 3
    assert (
        "a shard cannot store its tally (an instance where the example has none); docs/your-own/metric.md says"
        in done.err
    )
    smart = json.loads(done.out)["peers"]["smart"]
    assert smart["largest_error"] is None
    assert smart["mean_squared_error"] > 0


def test_a_metric_that_needs_states_is_null_without_them(evedrop: Evedrop) -> None:
    """And one of eavesdroppers is not the legitimate estimator's."""
    facts = "    needs_states = True\n    of = 'eavesdropper'\n    by_trial = True\n"
    environment = installed(evedrop, of_the_docs().replace("    by_trial = True\n", facts))
    done = evedrop.process(
        "montecarlo", "eavesdroppers", "--slots", "9", "--trials", "2", "--covariance-only", "--json", env=environment
    )
    peers = json.loads(done.out)["peers"]
    assert peers["smart"]["largest_error"] is None
    assert "largest_error" not in peers["legitimate"]
    expect = "expect.0={metric = 'legitimate.largest_error', below = 1.0}"
    done = evedrop.process("check", "eavesdroppers", "--set", expect, env=environment)
    assert (done.status, "did you mean" in done.err) == (2, True)


@pytest.mark.parametrize(
    ("name", "module", "message"),
    [
        ("largest_error", "raise RuntimeError('not today')\n", "cannot be imported (RuntimeError: not today"),
        ("digest", of_the_docs(), "; expected a name of letters, digits and _"),
    ],
)
def test_a_metric_that_cannot_be_loaded_is_left_out(evedrop: Evedrop, name: str, module: str, message: str) -> None:
    """The closing report says why; an expectation that names it is a mistake, with the reason."""
    environment = installed(evedrop, module, name)
    run = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "2")
    done = evedrop.process(*run, env=environment)
    assert done.status == 0, done.err
    assert f"the metric {name} is left out" in done.out
    assert message in done.out
    done = evedrop.process(*run, "--set", f"expect.0={{metric = 'smart.{name}', below = 1.0}}", env=environment)
    assert done.status == 2
    assert message in done.err


def test_docs_say_of_every_metric_what_it_says_itself() -> None:
    """In the table of docs/metrics.md, and in the entry of docs/scenario.md those that an expectation can name."""
    results, scenario = ((DOCS / page).read_text(encoding="utf-8") for page in ("metrics.md", "scenario.md"))
    for name in METRICS:
        meaning = metric(name).meaning
        for plain, typeset in (("|x − x̂|²", r"$\lvert x - \hat x\rvert^2$"), ("tr P", r"$\mathrm{tr}\ P$")):
            meaning = meaning.replace(plain, typeset)
        assert f"\n| `{name}` | {meaning} |\n" in results
        assert (f"`{name}`" in scenario) == (metric(name).only_in_mode is None)


@pytest.mark.parametrize("name", [name for name, metric in metrics_of("smart").items() if metric.only_in_mode is None])
def test_a_metric_over_all_slots_is_that_of_the_totals(name: str) -> None:
    """Kept by its tally, or computed from what is counted of every receiver."""
    from evedrop.score.sums import Tally, slot_sums

    draw = np.random.default_rng(2)
    error, action = draw.lognormal(size=(30, 4)), draw.integers(0, 4, (30, 4)).astype(np.uint8)
    trace, expected = draw.lognormal(size=(30, 2)), draw.lognormal(size=30)
    tally, kept = Tally(30, 4), metric(name).tally(4)
    tally.add_slots(0, error, slot_sums(error, action, trace), expected)
    for first in (0, 11):
        rows = slice(first, 11 if first == 0 else 30)
        kept.add(ScoredSlots(first, error[rows], action[rows], trace[rows, 0], expected[rows]))
    value: Any = tally.metric(name)
    assert kept.value == pytest.approx(value, rel=1e-12)


ADD, VALUE, TRIALS, TALLY = (
    "        self.largest = np.maximum",
    "return float(largest) if largest >= 0.0 else None",
    "def of_trials(self)",
    "return LargestTally(trials)",
)
FAILING = {
    "an error in a slot": (ADD, f"        raise ValueError('no')\n{ADD}", "ValueError: no, largest.py line {}"),
    "an error at the end": (VALUE, "raise ValueError('no')", "ValueError: no, largest.py line {}"),
    "no number": (VALUE, "return 'abc'", "value gave 'abc'; expected a number, or None"),
    "no trials": (TRIALS, "def of_each_trial(self)", "of_trials gave None; expected an array of 4 numbers"),
    "no tally": (TALLY, "return None", "tally() gave None; expected a MetricTally"),
}
"""What fails → the line of the module, its replacement, and the expected message."""


@pytest.mark.parametrize("case", FAILING)
@pytest.mark.parametrize("how", ["in memory", pytest.param("live", marks=pytest.mark.long)])
def test_a_metric_that_fails_costs_no_other(evedrop: Evedrop, case: str, how: str) -> None:
    """It is null; all else is measured and saved; then the run fails with status 3, and names metric, error and line."""
    line, instead, message = FAILING[case]
    module = of_the_docs().replace(line, instead)
    message = message.format(module[: module.find(instead.splitlines()[0])].count("\n") + 1)
    environment = installed(evedrop, module)
    command = ("run", "--view", "off") if how == "live" else ("montecarlo", "--workers", "1")
    expect = "expect.0={metric = 'smart.largest_error', above = 0.0, quantile = 0.5}"
    changes = ("--slots", "30", "--trials", "4", "--set", expect, "--out", "run")
    done = evedrop.process(command[0], "eavesdroppers", *command[1:], *changes, env=environment)
    assert done.status == 3, done.err
    assert f"the metric largest_error of an installed package failed: {message}" in done.err
    assert "Traceback" not in done.err
    summary = Results.read(evedrop.folder / "run").summary
    assert summary["ended"] in done.err
    assert summary["slots"] == 30
    assert summary["peers"]["smart"]["mean_squared_error"] > 0.0
    assert summary["peers"]["smart"]["digest"] is not None
    assert summary["expectations"][0]["held"] is None


def test_what_a_metric_prints_does_not_mix_with_the_events(evedrop: Evedrop) -> None:
    """It goes to the recorder's log, and the launcher reads every event."""
    prints = f"        print('hello', end='')\n        import os; os.write(1, b'again')\n{ADD}"
    environment = installed(evedrop, of_the_docs().replace(ADD, prints))
    done = evedrop.process("run", "eavesdroppers", "--slots", "60", "--view", "off", "--out", "run", env=environment)
    assert done.status == 0, done.err
    log = (evedrop.folder / "run" / "logs" / "recorder.log").read_text()
    assert log
    assert log.replace("hello", "").replace("again", "") == ""
