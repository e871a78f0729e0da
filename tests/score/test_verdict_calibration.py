"""Z-scores and verdicts at the sizes and for the systems that the documents use, over many independent studies.

`python -m pytest tests/score/test_verdict_calibration.py -m long -s` prints the table of which docs/montecarlo.md has the sums.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Floats
from evedrop.names import LEGITIMATE
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import Expectation, expectations_of
from evedrop.score.rare_events import z_of_error
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import verdicts
from evedrop.score.secrecy import Claim
from evedrop.score.summary import RARE_FRACTION, RareEvents
from evedrop.score.verdict import SecrecyOutcome
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import carry_out, tasks_of

SEED = 2718
REPOSITORY = Path(__file__).parents[2]
PAGES = {"buoy.toml": "docs/tutorial.md", "mine.toml": "README.md"}
"""Scenario → the page whose first scenario it is."""
BURSTS = {"loss": {"model": "gilbert-elliott", "p": 0.01, "r": 0.033}}


@dataclass(frozen=True)
class Documented:
    """A command of the documents, and the number of studies of its size that are drawn."""

    command: str
    source: str
    trials: int
    studies: int
    changes: Mapping[str, Any]

    @property
    def scenario(self) -> Scenario:
        """Its scenario with as many trials as all studies have, and another seed."""
        changes = {**self.changes, "trials": self.trials * self.studies, "seed": SEED, "expect": [], "record_trials": 1}
        if self.source not in PAGES:
            return load(self.source, changes)
        page = (REPOSITORY / PAGES[self.source]).read_text(encoding="utf-8")
        text = re.findall(r"```toml\n(title = .*?)```", page, re.DOTALL)[0]
        return checked({**tomllib.loads(text), **changes}, self.source)


DOCUMENTED = [
    Documented("vehicle --trials 200", "vehicle", 200, 60, {}),
    Documented("buoy.toml --trials 1000", "buoy.toml", 1000, 150, {}),
    Documented("buoy.toml --trials 500", "buoy.toml", 500, 100, {}),
    Documented("buoy.toml --trials 500, with bursts", "buoy.toml", 500, 100, {"legitimate": {"link": BURSTS}}),
    Documented("mine.toml --trials 1000", "mine.toml", 1000, 100, {}),
    Documented("eavesdroppers --trials 2000 --slots 500", "eavesdroppers", 2000, 40, {"slots": 500}),
    *(
        Documented(
            f"eavesdroppers --trials 500 --slots 200, μ_d = {mu_d}",
            "eavesdroppers",
            500,
            40,
            {"slots": 200, "encoding": {"scheme": "innovation", "state_probability": mu_d}},
        )
        for mu_d in (0.1, 0.3, 0.5, 0.7, 0.9)
    ),
    Documented("partial-encryption --trials 200", "partial-encryption", 200, 150, {}),
    Documented("acknowledged --trials 1000", "acknowledged", 1000, 100, {}),
]


def tally_of(scenario: Scenario) -> RunTally:
    """The tally of all its trials, simulated in memory."""
    batches = [carry_out(task, lambda _: None, lambda: False) for task in tasks_of(scenario, Mode.EXACT, 1)]
    return RunTally.merged([block.run_tally for batch in batches for block in batch.blocks])


def rare_events(expected: Expectation, slots: int, trials: int) -> RareEvents | None:
    """The rare events of a study of so many trials."""
    streaks = expected.streaks(slots)
    return None if streaks is None else RareEvents(streaks.fraction(trials), streaks.trials_for(RARE_FRACTION))


def z_scores(documented: Documented) -> dict[str, list[float | None]]:
    """Receiver → the z-score of its mean squared error in each study; for receivers whose expectation is known."""
    scenario = documented.scenario
    run_tally, scores_of = tally_of(scenario), {}
    for name, expected in expectations_of(scenario).items():
        if not expected.known or expected.of_model:
            continue
        means: Floats = run_tally.tallies[name].window_errors.sum(axis=0) / scenario.slots
        theory, rare = (
            float(expected.traces(scenario.slots).mean()),
            rare_events(expected, scenario.slots, documented.trials),
        )
        scores_of[name] = [
            z_of_error(study, theory, expected, scenario.slots, rare)
            for study in means.reshape(documented.studies, documented.trials)
        ]
    return scores_of


@pytest.mark.long
def test_z_is_calibrated_at_the_sizes_of_the_documents(capsys: pytest.CaptureFixture[str]) -> None:
    """Over 1000 studies: |z| above 1.96 in 3 to 7 % and above 3 in less than 0.6 %, legitimate estimator and eavesdroppers."""
    sides: dict[str, list[float]] = {"legitimate": [], "eavesdroppers": []}
    lines = []
    for documented in DOCUMENTED:
        for name, scores in z_scores(documented).items():
            z = [score for score in scores if score is not None]
            sides["legitimate" if name == LEGITIMATE else "eavesdroppers"] += z
            lines.append(f"| `{documented.command}` | {name} | {row(scores)} |")
    lines += [f"| all | {side} | {row(list(z))} |" for side, z in sides.items()]
    with capsys.disabled():
        print("", *lines, sep="\n")  # noqa: T201 - the table of the page
    assert sum(documented.studies for documented in DOCUMENTED) == 1000
    for side, given in sides.items():
        beyond = np.abs(given)
        assert len(given) > 300, side
        assert 0.03 <= np.mean(beyond > 1.96) <= 0.07, side
        assert np.mean(beyond > 3.0) < 0.006, side


def row(scores: list[float | None]) -> str:
    """How many studies, in how many of them the z-score is given, and how often it is beyond 1.96 and 3, below and above."""
    z = np.array([score for score in scores if score is not None])
    fractions = [np.mean(z < -1.96), np.mean(z > 1.96), np.mean(z < -3.0), np.mean(z > 3.0)] if len(z) else []
    shown = [f"{100 * fraction:.1f} %" for fraction in fractions] or ["–"] * 4
    return " | ".join([f"{len(scores)}", f"{len(z)}", *shown])


def gambled(initial: float, seed: int, strategy: str = "smart") -> Scenario:
    """An estimator that rarely loses the packet of slot 0, but then has a huge error, and an eavesdropper that loses none."""
    return checked(
        {
            "title": "rare and huge",
            "slots": 64,
            "seed": seed,
            "trials": 200,
            "process": {"A": [[1.0]], "Q": [[1.0]], "initial_covariance": [[initial]]},
            "encoding": {"scheme": "innovation", "state_probability": 0.02},
            "legitimate": {"link": {"quality": 0.99}},
            "eavesdroppers": {"e": {"strategy": strategy, "link": {"quality": 1.0}}},
        },
        "gambled",
    )


@pytest.mark.parametrize("seeds", [40, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.parametrize("initial", [1e6, 1e4])
def test_no_verdict_is_false_where_rare_events_carry_the_users_error(seeds: int, initial: float) -> None:
    """The estimator's expected error is the larger one in all windows, or in all but the last: `held` is never true."""
    expected = {
        name: theory.traces(64)[1:].reshape(-1) for name, theory in expectations_of(gambled(initial, 0)).items()
    }
    assert np.mean(expected["e"]) < np.mean(expected[LEGITIMATE])
    relative = []
    for seed in range(seeds):
        scenario = gambled(initial, seed)
        entries, _, overall = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
        relative.append(entries["e"].relative)
        assert overall is not None
        if np.mean(expected["e"][32:]) < np.mean(expected[LEGITIMATE][32:]):
            assert overall.outcome not in {SecrecyOutcome.RELATIVE, SecrecyOutcome.PERFECT}
    assert Claim.HELD not in relative


@pytest.mark.parametrize("seeds", [10, pytest.param(200, marks=pytest.mark.long)])
def test_no_verdict_is_false_for_a_strategy_without_a_closed_form(seeds: int) -> None:
    """The same against an eavesdropper whose expected error nothing but the simulation tells."""
    for seed in range(seeds):
        scenario = gambled(1e6, seed, "bayesian")
        entries, _, overall = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
        assert entries["e"].relative != Claim.HELD
        assert overall is not None
        assert overall.outcome not in {SecrecyOutcome.RELATIVE, SecrecyOutcome.PERFECT}
        assert not expectations_of(scenario)["e"].known
