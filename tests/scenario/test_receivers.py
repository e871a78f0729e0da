"""Tables of eavesdroppers and links: every mistake is named."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
import tomli_w

from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.results.resolved_scenario import resolved
from evedrop.scenario.loading import checked, parse
from evedrop.scenario.tables import Scenario
from tests.builders import GOOD, mistakes_in_good, mistakes_of, places_of
from tests.golden.pages import Golden

POOL = {"strategy": "colluding", "links": [{"quality": 0.6}, {"quality": 0.5}], "reads_as": "smart"}
SPY = {"strategy": "replay-informed", "learns_at": 5, "reads_as": "bayesian", "link": {"quality": 0.5}}


@pytest.mark.parametrize(
    ("table", "places"),
    [
        ({**POOL, "links": None}, ["links"]),
        ({**POOL, "links": []}, ["links"]),
        pytest.param({**POOL, "links": [{"quality": 2.0}] * 17}, ["links"], id="17 links"),
        ({**POOL, "links": [{"quality": 2.0}, {}]}, ["links.0.quality", "links.1.quality"]),
        ({**POOL, "link": {"quality": 0.5}}, ["link"]),
        ({**POOL, "reads_as": None}, ["reads_as"]),
        ({**POOL, "reads_as": "colluding"}, ["reads_as"]),
        ({**POOL, "reads_as": "suspicious", "use_state": 0.5}, ["use_innovation"]),
        ({**SPY, "learns_at": None}, ["learns_at"]),
        ({**SPY, "learns_at": -1}, ["learns_at"]),
        ({**SPY, "learns_at": 50}, ["learns_at"]),
        ({"strategy": "clever"}, ["strategy"]),
    ],
    ids=str,
)  # fmt: skip
def test_a_mistake_of_an_eavesdropper_is_named(table: dict[str, Any], places: list[str], golden: Golden) -> None:
    """Missing, superfluous and wrong entries of a strategy: a line each."""
    given = {name: value for name, value in table.items() if value is not None}
    mistakes = mistakes_in_good({"eavesdroppers.eve": given})
    assert sorted(places_of(mistakes)) == sorted(f"eavesdroppers.eve.{place}" for place in places)
    golden("check", mistakes)


class Named(Naive):
    """Has parameters with the names of methods of the table."""

    parameters = MappingProxyType({"entries": 1, "mistakes": 2})


def test_parameters_may_have_any_name() -> None:
    """What stands in the file reaches the class."""
    given = {"entries": 5, "mistakes": 6}
    eve = {"strategy": f"{__name__}:Named", "link": {"quality": 0.9}, **given}
    scenario = parse(tomli_w.dumps(GOOD), "scenario", {"eavesdroppers": {"eve": eve}})
    assert scenario.eavesdroppers["eve"].parameters == given


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
def test_who_needs_a_schedule_is_refused_where_there_is_none(strategy: str, entry: str, golden: Golden) -> None:
    """Told with the strategies that can do without."""
    table = {"strategy": strategy, "link": {"quality": 0.8}} if entry == "strategy" else {**POOL, "reads_as": strategy}
    mistakes = mistakes_in_good({"encoding": {"scheme": "plain"}, "eavesdroppers": {"eve": table}})
    assert places_of(mistakes) == [f"eavesdroppers.eve.{entry}"]
    golden("check", mistakes)


BURSTS = {"model": "gilbert-elliott", "p": 0.05, "r": 0.5}
CHAIN = {"model": "markov", "transitions": [[0.9, 0.1], [0.5, 0.5]], "loss": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("link", "place"),
    [
        ({}, "link.quality"),
        ({"quality": 0.9, "loss": BURSTS}, "link.quality"),
        ({"loss": 3}, "link.loss"),
        ({"loss": {}}, "link.loss.model"),
        ({"loss": {"model": "gilbert"}}, "link.loss.model"),
        ({"loss": {"model": ["x"]}}, "link.loss.model"),
        ({"loss": {"model": "bernoulli", "quality": 1.5}}, "link.loss.quality"),
        ({"loss": {"model": "gilbert-elliott", "p": 0.1}}, "link.loss.r"),
        ({"loss": {**BURSTS, "q": 0.1}}, "link.loss.q"),
        ({"loss": {**BURSTS, "p": "often"}}, "link.loss.p"),
        ({"loss": {**BURSTS, "good": True}}, "link.loss.good"),
        ({"loss": {**BURSTS, "bad": float("nan")}}, "link.loss.bad"),
        ({"loss": {**BURSTS, "p": 0, "r": 0.0}}, "link.loss.p"),
        ({"loss": {**CHAIN, "transitions": 0.5}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "transitions": []}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "transitions": [[0.5, 0.5]]}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "transitions": [[0.9, 0.2], [0.5, 0.5]]}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "transitions": [[1.5, -0.5], [0.5, 0.5]]}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "transitions": [[1, 0], [0, 1]]}}, "link.loss.transitions"),
        ({"loss": {**CHAIN, "loss": [0.0]}}, "link.loss.loss"),
        ({"loss": {**CHAIN, "loss": [0.0, 2.0]}}, "link.loss.loss"),
        ({"loss": {"model": "pattern", "outcomes": "11x1"}}, "link.loss.outcomes"),
        ({"loss": {"model": "pattern", "outcomes": ""}}, "link.loss.outcomes"),
        ({"loss": {"model": "pattern", "outcomes": 11}}, "link.loss.outcomes"),
    ],
    ids=str,
)  # fmt: skip
def test_a_mistake_of_a_link_is_named(link: dict[str, Any], place: str, golden: Golden) -> None:
    """A mistake in the legitimate link or in an eavesdropper's link gets one line, with the path of the entry."""
    for receiver in ("legitimate", "eavesdroppers.smart"):
        mistakes = mistakes_in_good({f"{receiver}.link": link})
        assert places_of(mistakes) == [f"{receiver}.{place}"]
        golden("check", mistakes)


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


SLOW = """
from evedrop.extend import DelayModel
class Slow(DelayModel):
    parameters = {"value": 2.0, "more": 1.0}
    optional = frozenset({"more"})
    lengths = ("value", "more")
    def __init__(self, value, more=1.0):
        self.value = value + more
    def delays(self, first, numbers):
        return 0.0 * numbers + self.value
    def arrived(self, lag):
        return None
"""


def test_lengths_of_an_own_delay_model_may_be_left_out_and_wrong(tmp_path: Path) -> None:
    """Lengths in seconds: an omitted one keeps its default, and a text is reported as a mistake."""
    (tmp_path / "slow.py").write_text(SLOW)
    delay = {"model": "slow:Slow", "value": 1.0, "unit": "seconds"}
    tables = {**GOOD, "slot_seconds": 0.5, "modules": str(tmp_path)}
    own = checked({**tables, "legitimate": {"link": {"quality": 0.9, "delay": delay}}}, "own")
    assert own.schedule("legitimate").settings["delay"] == {"model": "slow:Slow", "value": 2.0}
    link = {"quality": 0.9, "delay": {**delay, "value": "long"}}
    (line,) = mistakes_of(checked, {**tables, "legitimate": {"link": link}}, "own")
    assert line.startswith('legitimate.link.delay.model: is "slow:Slow"; in a dry run: ')
