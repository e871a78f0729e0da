"""Tables of eavesdroppers and links: every mistake is named."""

from __future__ import annotations

from typing import Any

import pytest
import tomli_w

from evedrop.results.resolved_scenario import resolved
from evedrop.scenario.loading import parse
from evedrop.scenario.tables import Scenario
from tests.builders import GOOD, mistakes_in_good

POOL = {"strategy": "colluding", "links": [{"quality": 0.6}, {"quality": 0.5}], "reads_as": "smart"}
SPY = {"strategy": "replay-informed", "learns_at": 5, "reads_as": "bayesian", "link": {"quality": 0.5}}


@pytest.mark.parametrize(
    ("table", "starts"),
    [
        ({**POOL, "links": None}, ["links: is missing; the strategy colluding needs it; expected links = [{ quality"]),
        ({**POOL, "links": []}, ["links: has fewer than 2 entries; expected at least that many"]),
        ({**POOL, "links": [{"quality": 2.0}] * 17}, ["links: has more than 16 entries; expected at most that many"]),
        ({**POOL, "links": [{"quality": 2.0}, {}]}, ["links.0.quality: is 2.0; expected a number from 0 to 1, such as",
                                                     "links.1.quality: is missing; expected quality = 0.9, or a loss"]),
        ({**POOL, "link": {"quality": 0.5}}, ["link: is set, but the strategy colluding has no such parameter; its ent"]),
        ({**POOL, "reads_as": None}, ['reads_as: is missing; the strategy colluding needs it; expected reads_as = "sm']),
        ({**POOL, "reads_as": "colluding"}, ['reads_as: is "colluding"; expected bayesian, clear-states, constant, genie']),
        ({**POOL, "reads_as": "suspicious", "use_state": 0.5}, ["use_innovation: is missing; the strategy colluding ne"]),
        ({**SPY, "learns_at": None}, ["learns_at: is missing; the strategy replay-informed needs it; expected learns_at"]),
        ({**SPY, "learns_at": -1}, ["learns_at: is -1; expected a number at least 0, such as 40"]),
        ({**SPY, "learns_at": 50}, ["learns_at: is 50; expected a slot of the run, 0 to 49"]),
        ({"strategy": "clever"}, ['strategy: is "clever"; expected']),
    ],
)  # fmt: skip
def test_a_mistake_of_an_eavesdropper_is_named(table: dict[str, Any], starts: list[str]) -> None:
    """Missing, superfluous and wrong entries of a strategy: a line each."""
    given = {name: value for name, value in table.items() if value is not None}
    mistakes = mistakes_in_good({"eavesdroppers.eve": given})
    assert len(mistakes) == len(starts), mistakes
    for line, start in zip(sorted(mistakes), sorted(starts), strict=True):
        assert line.startswith(f"eavesdroppers.eve.{start}")


def test_eavesdroppers_that_are_right_are_taken() -> None:
    """With exactly what each strategy needs; the parameters are those that its process is told."""
    suspicious = {"reads_as": "suspicious", "use_state": 0.5, "use_innovation": 0.1}
    tables = {"pool": POOL, "spy": SPY, "careful": {**POOL, **suspicious}}
    link = {"link": {"quality": 0.9}}
    tables |= {name: {"strategy": name, **link} for name in ("constant", "genie", "bayesian", "likelihood")}
    scenario = parse(tomli_w.dumps(GOOD), "scenario", {"eavesdroppers": tables})
    assert {name: table.parameters for name, table in scenario.eavesdroppers.items()} == {
        **{name: {} for name in tables},
        "pool": {"reads_as": "smart"},
        "spy": {"reads_as": "bayesian", "learns_at": 5},
        "careful": suspicious,
    }
    assert scenario.quality["pool"] == pytest.approx(1 - 0.4 * 0.5)
    assert Scenario.model_validate(scenario.model_dump(mode="json")) == scenario
    assert parse(resolved(scenario), "resolved").eavesdroppers == scenario.eavesdroppers


@pytest.mark.parametrize(("strategy", "entry"), [("smart", "strategy"), ("genie", "strategy"), ("smart", "reads_as")])
def test_who_needs_a_schedule_is_refused_where_there_is_none(strategy: str, entry: str) -> None:
    """Told with the strategies that can do without."""
    table = {"strategy": strategy, "link": {"quality": 0.8}} if entry == "strategy" else {**POOL, "reads_as": strategy}
    (line,) = mistakes_in_good({"encoding": {"scheme": "plain"}, "eavesdroppers": {"eve": table}})
    assert line == (
        f'eavesdroppers.eve.{entry}: is "{strategy}", which is defined by its knowledge of the schedule, and the scheme '
        "plain has none; expected bayesian, clear-states, constant, learning-em, likelihood, naive, power-test, reference, "
        "selective or tracker"
    )


BURSTS = {"model": "gilbert-elliott", "p": 0.05, "r": 0.5}
CHAIN = {"model": "markov", "transitions": [[0.9, 0.1], [0.5, 0.5]], "loss": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ({}, "link.quality: is missing; expected quality = 0.9, or a loss model"),
        ({"quality": 0.9, "loss": BURSTS}, "link.quality: is given together with loss, whose short form it is"),
        ({"loss": 3}, "link.loss: is 3; expected a table, such as"),
        ({"loss": {}}, 'link.loss.model: is missing; expected model = "bernoulli", or another'),
        ({"loss": {"model": "gilbert"}}, 'link.loss.model: is "gilbert"; expected bernoulli'),
        ({"loss": {"model": ["x"]}}, 'link.loss.model: is ["x"]; expected bernoulli'),
        ({"loss": {"model": "bernoulli", "quality": 1.5}}, "link.loss.quality: is 1.5; expected a number from 0 to 1"),
        ({"loss": {"model": "gilbert-elliott", "p": 0.1}}, "link.loss.r: is missing; the loss model gilbert-elliott needs it"),
        ({"loss": {**BURSTS, "q": 0.1}}, "link.loss.q: is set, but the loss model gilbert-elliott has no such"),
        ({"loss": {**BURSTS, "p": "often"}}, 'link.loss.p: is "often"; expected a number from 0 to 1'),
        ({"loss": {**BURSTS, "good": True}}, "link.loss.good: is true; expected a number from 0 to 1"),
        ({"loss": {**BURSTS, "bad": float("nan")}}, "link.loss.bad: is nan; expected a number from 0 to 1"),
        ({"loss": {**BURSTS, "p": 0, "r": 0.0}}, "link.loss.p: and r are both 0"),
        ({"loss": {**CHAIN, "transitions": 0.5}}, "link.loss.transitions: is not a matrix"),
        ({"loss": {**CHAIN, "transitions": []}}, "link.loss.transitions: is not a matrix"),
        ({"loss": {**CHAIN, "transitions": [[0.5, 0.5]]}}, "link.loss.transitions: is not square"),
        ({"loss": {**CHAIN, "transitions": [[0.9, 0.2], [0.5, 0.5]]}}, "link.loss.transitions: row 0 sums to 1.1; expe"),
        ({"loss": {**CHAIN, "transitions": [[1.5, -0.5], [0.5, 0.5]]}}, "link.loss.transitions: row 0 is [1.5, -0.5]; e"),
        ({"loss": {**CHAIN, "transitions": [[1, 0], [0, 1]]}}, "link.loss.transitions: has several recurrent classes"),
        ({"loss": {**CHAIN, "loss": [0.0]}}, "link.loss.loss: is [0.0]; expected 2 numbers from 0 to 1, one for each"),
        ({"loss": {**CHAIN, "loss": [0.0, 2.0]}}, "link.loss.loss: is [0.0, 2.0]; expected 2 numbers"),
        ({"loss": {"model": "pattern", "outcomes": "11x1"}}, 'link.loss.outcomes: is "11x1"; expected a word of 0'),
        ({"loss": {"model": "pattern", "outcomes": ""}}, 'link.loss.outcomes: is ""; expected a word of 0 (lost)'),
        ({"loss": {"model": "pattern", "outcomes": 11}}, "link.loss.outcomes: is 11; expected a word of 0 (lost)"),
    ],
)  # fmt: skip
def test_a_mistake_of_a_link_is_named(link: dict[str, Any], message: str) -> None:
    """A mistake in the legitimate link or in an eavesdropper's link gets one line, with the path of the entry."""
    for receiver in ("legitimate", "eavesdroppers.smart"):
        (line,) = mistakes_in_good({f"{receiver}.link": link})
        assert line.startswith(f"{receiver}.{message}")


def test_all_mistakes_of_links_are_named_at_once() -> None:
    """What is missing, unknown and wrong, in one loss model and in several."""
    mistakes = mistakes_in_good(
        {
            "legitimate.link": {"loss": {"model": "gilbert-elliott", "p": 2.0, "q": 0.1}},
            "eavesdroppers.smart.link": {
                "loss": {"model": "markov", "transitions": [[0.9, 0.2], [0.5, 0.4]], "loss": [0]}
            },
            "eavesdroppers.other": {"strategy": "smart", "link": {"loss": {"model": "pattern", "word": "1"}}},
            "slots": 0,
        }
    )
    for path, count in (
        ("legitimate.link.loss.p: ", 1),
        ("legitimate.link.loss.r: ", 1),
        ("legitimate.link.loss.q: ", 1),
        ("eavesdroppers.smart.link.loss.transitions: ", 2),
        ("eavesdroppers.smart.link.loss.loss: ", 1),
        ("eavesdroppers.other.link.loss.outcomes: ", 1),
        ("eavesdroppers.other.link.loss.word: ", 1),
        ("slots: ", 1),
    ):
        assert len([line for line in mistakes if line.startswith(path)]) == count, path
    assert len(mistakes) == 9
