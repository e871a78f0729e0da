"""Every shipped scenario: the same bits live and in memory, every packet accounted for, theory met."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import montecarlo, run
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenarios import shipped
from tests.builders import digests_of
from tests.examples import mostly_long

SLOTS = 300
"""Enough for a whole block of digests and a part of one."""

BATCHES = {"a later trial": (1, 17), "forty trials": (40, 5)}
"""Trials, and the number of the first."""

SHORTER: dict[str, dict[str, Any]] = {"learning": {"slots": 60, "expect": []}}
"""Changes of scenarios whose slots take long, for the test with one trial; the test with forty trials uses none."""

Pair = tuple[Results, Results]


@pytest.fixture(scope="session")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Pair]:
    """The same trials of a scenario live and in memory, run once for all tests."""

    @cache
    def made(name: str, batch: str) -> Pair:
        trials, first = BATCHES[batch]
        folder = tmp_path_factory.mktemp("twins")
        scenario = load(name)
        timed = scenario.event or any(expect.slots or expect.by for expect in scenario.expect)
        slots = scenario.slots if timed else min(SLOTS, scenario.slots)
        options: dict[str, Any] = {"slots": slots, "trials": trials, "first_trial": first, "pace": 0.0}
        if trials == 1:
            options |= SHORTER.get(name, {})
        return run(name, out=folder / "live", **options), montecarlo(name, out=folder / "memory", **options)

    return made


def blocks(results: Results) -> set[tuple[str, int, int, bytes]]:
    """Receiver, trial, block and digest of every block."""
    return set(zip(*(results.digests[name].to_pylist() for name in ("peer", "trial", "block", "digest")), strict=True))


USUAL = [
    ("acknowledged", "a later trial"),
    ("eavesdroppers", "a later trial"),
    ("colluding", "forty trials"),
    ("cut", "forty trials"),
    ("heated-room", "forty trials"),
    ("late", "forty trials"),
    ("replay-attack-before", "forty trials"),
]
"""What differs in kind: schemes, pools of links, events, closed loops, delays, attacks, and one trial."""

every_batch = pytest.mark.parametrize(
    ("name", "batch"), mostly_long([(name, batch) for name in sorted(shipped()) for batch in BATCHES], USUAL)
)


@pytest.mark.thorough
@every_batch
def test_live_and_memory_are_the_same_bits(name: str, batch: str, twins: Callable[[str, str], Pair]) -> None:
    """Equal digests of every receiver, equal sums, and a verdict that agrees."""
    live, memory = twins(name, batch)
    assert digests_of(live) == digests_of(memory)
    assert all(digests_of(live).values())
    assert blocks(live) == blocks(memory)
    for receiver, metrics in live.summary["peers"].items():
        same = memory.summary["peers"][receiver]
        assert metrics.keys() == same.keys()
        for metric, entry in metrics.items():
            # Differences of trials cancel more digits than their sums do.
            apart = 1e-9 if metric in {"standard_errors", "z"} else 1e-12
            if isinstance(entry, dict):
                alike = dict(same[metric])
                if metric == "standard_errors" and entry["mean_trace_covariance"] is None:
                    alike["mean_trace_covariance"] = None  # only memory knows tr P of trials that are not recorded
                assert entry.keys() == alike.keys()
                for part, value in entry.items():
                    assert value == (alike[part] if alike[part] is None else pytest.approx(alike[part], rel=apart)), (
                        part
                    )
            elif metric != "digest":
                assert entry == (same[metric] if same[metric] is None else pytest.approx(same[metric], rel=apart))
    for eavesdropper, verdict in live.summary["secrecy"].items():
        ratios = {
            key: pytest.approx(verdict[key], rel=1e-9) for key in ("ratio", "ratio_standard_error") if verdict[key]
        }
        assert memory.summary["secrecy"][eavesdropper] == {**verdict, **ratios}
    assert live.summary["directions"] == memory.summary["directions"]
    assert live.summary.get("integrity", {}).get("digest") == memory.summary.get("integrity", {}).get("digest")


@pytest.mark.thorough
@every_batch
def test_every_packet_is_accounted_for(name: str, batch: str, twins: Callable[[str, str], Pair]) -> None:
    """Offered is slots times trials; delivered and lost add up to it; the journal says the same, slot by slot."""
    live, _ = twins(name, batch)
    trials, slots = BATCHES[batch][0], live.summary["slots"]
    journal = live.journal.to_pydict()
    for receiver, link in live.summary["links"].items():
        rows = [i for i, name in enumerate(journal["link"]) if name == receiver]
        assert link["offered"] == slots * trials == sum(journal["offered"][i] for i in rows)
        in_time, late = (sum(journal[column][i] for i in rows) for column in ("delivered", "late"))
        assert (link["delivered"], link["late"]) == (in_time + late, late)
        assert link["lost"] == sum(journal["lost"][i] for i in rows) == sum(link["lost_by"].values())
        assert link["delivered"] + link["lost"] == link["offered"]
        assert link["unexplained"] == 0
        masks = [int.from_bytes(journal["delivered_mask"][i], "little").bit_count() for i in rows]
        assert masks == [journal["delivered"][i] for i in rows]


def test_later_trials_are_the_same_alone(tmp_path: Path) -> None:
    """Trials 17 to 19 alone are trials 17 to 19 of forty."""
    few = montecarlo("eavesdroppers", slots=SLOTS, trials=3, first_trial=17, out=tmp_path / "few")
    many = montecarlo("eavesdroppers", slots=SLOTS, trials=40, out=tmp_path / "many")
    assert blocks(few) == {row for row in blocks(many) if 17 <= row[1] < 20}


@pytest.mark.thorough
def test_a_further_eavesdropper_changes_nobody_else(tmp_path: Path, twins: Callable[[str, str], Pair]) -> None:
    """Neither by its presence nor by its place among the others."""
    extra: dict[str, Any] = {"eavesdroppers__extra__strategy": "smart", "eavesdroppers__extra__link__quality": 0.5}
    slots = load("numerical").slots
    live = run("numerical", slots=slots, pace=0.0, trials=1, first_trial=17, out=tmp_path / "extra", **extra)
    digests = digests_of(live)
    assert digests.pop("extra")
    assert digests == digests_of(twins("numerical", "a later trial")[1])


@pytest.mark.thorough
def test_the_resolved_scenario_runs_to_the_same_digests(tmp_path: Path, twins: Callable[[str, str], Pair]) -> None:
    """The scenario.toml of a results folder, and the folder itself, repeat the run."""
    live, _ = twins("eavesdroppers", "a later trial")
    again = montecarlo(live.folder / "scenario.toml", trials=1, out=tmp_path / "file")
    folder = montecarlo(live.folder, trials=1, out=tmp_path / "folder")
    assert digests_of(again) == digests_of(folder) == digests_of(live)


def test_simulated_errors_agree_with_theory(tmp_path: Path) -> None:
    """Every receiver of a marginally stable process, 600 trials: at no time the mean error is 4.5 standard errors off.

    The slots of a trial depend on each other, so each of 12 slots is judged by itself; 4.5 standard errors are exceeded
    by a normal mean with a probability below 7e-6, 48 times that for all of them.
    """
    results = montecarlo("eavesdroppers", slots=221, trials=600, seed=5, out=tmp_path / "many")
    table = results.slots.to_pydict()
    receivers = results.summary["peers"]
    judged = 0
    for i, slot in enumerate(table["slot"]):
        if slot % 20 == 0:
            difference = table["mean_squared_error"][i] - table["theoretical_trace_covariance"][i]
            assert abs(difference) < 4.5 * table["standard_error"][i] + 1e-15, (slot, table["peer"][i])
            judged += 1
    assert judged == 12 * len(receivers)
    for name, metrics in receivers.items():
        quality = load("eavesdroppers").quality[name]
        spread = np.sqrt(quality * (1 - quality) / (600 * 221))
        assert abs(metrics["received_fraction"] - quality) < 4.5 * spread
    for name in ("legitimate", "smart"):  # they know how well they do
        reported = receivers[name]["mean_trace_covariance"]
        assert reported == pytest.approx(receivers[name]["theoretical_trace_covariance"], rel=0.05)
    for name in ("naive", "suspicious"):  # they do not
        assert receivers[name]["mean_trace_covariance"] < 0.01 * receivers[name]["mean_squared_error"]


def test_results_are_read_back_as_they_were_returned(twins: Callable[[str, str], Pair]) -> None:
    """`load_results` of the folder is what the call gave."""
    live, _ = twins("eavesdroppers", "a later trial")
    assert Results.read(live.folder).summary == live.summary
    assert live.summary["ended"] == "complete"
