"""`[[expect]]` in a scenario: what is refused, how it is said, and the sentence it becomes."""

from __future__ import annotations

from typing import Any

import pytest
import tomli_w

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import parse
from evedrop.scenario.tables import Scenario
from tests.builders import mistakes_of, places_of, scalar_tables
from tests.golden.pages import Golden

CERTAIN = scalar_tables(
    1.0,
    1e-3,
    slots=50,
    trials=12,
    eavesdroppers={"smart": {"strategy": "smart", "link": {"quality": 0.8}}},
)
ERROR = "legitimate.mean_squared_error"


def expecting(*expectations: dict[str, Any], **changes: Any) -> Scenario:
    """The good scenario with these expectations."""
    tables = {**CERTAIN, "expect": list(expectations)}
    return parse(tomli_w.dumps(tables), "scenario", changes)


@pytest.mark.parametrize(
    ("expectation", "place"),
    [
        ({}, "metric"),
        ({"by": 3}, "synchronised"),
        ({"against": "smart"}, "secrecy"),
        ({"metric": ERROR, "below": 1.0, "link": "smart"}, "link"),
        ({"secrecy": "relative", "metric": ERROR}, "secrecy"),
        ({"link": "smart", "below": 1.0}, "below"),
        ({"synchronised": "smart", "by": 9, "slots": [0, 9]}, "slots"),
        ({"metric": ERROR}, "below"),
        ({"metric": ERROR, "within": 1.0}, "within"),
        ({"metric": ERROR, "within_relative": 0.1, "below": 1.0}, "within_relative"),
        ({"metric": ERROR, "near": 1.0}, "within"),
        ({"metric": ERROR, "near": 1, "within": 1, "within_relative": 1}, "within_relative"),
        ({"metric": ERROR, "near": 0, "within_relative": 0.1}, "within_relative"),
        ({"metric": ERROR, "near": 1, "within": -1}, "within"),
        ({"metric": ERROR, "near": 1, "within": "a bit"}, "within"),
        ({"metric": ERROR, "above": 2.0, "below": 1.0}, "above"),
        ({"metric": ERROR, "below": 1, "slots": 9}, "slots"),
        ({"metric": ERROR, "below": 1, "slots": [1, "x"]}, "slots.1"),
        ({"metric": ERROR, "below": 1, "slots": [9]}, "slots"),
        ({"metric": ERROR, "below": 1, "slots": [9, 9]}, "slots"),
        ({"metric": ERROR, "below": 1, "slots": [-1, 9]}, "slots"),
        ({"metric": ERROR, "below": 1, "slots": [9, 51]}, "slots"),
        ({"metric": ERROR, "below": 1, "quantile": 1.0}, "quantile"),
        ({"metric": ERROR, "below": 1, "quantile": 0}, "quantile"),
        ({"metric": ERROR, "below": 1, "quantile": 0.99}, "quantile"),
        ({"metric": "smart.mean_trace_covariance", "below": 1, "quantile": 0.5}, "quantile"),
        ({"metric": "links.smart.lost", "below": 1, "quantile": 0.5}, "quantile"),
        ({"metric": "links.smart.lost", "below": 1, "slots": [0, 9]}, "slots"),
        ({"metric": "links.smart.lots", "below": 1}, "metric"),
        ({"metric": "links.nobody.lost", "below": 1}, "metric"),
        ({"metric": "links.smart.lost_by.2", "below": 1}, "metric"),
        ({"metric": "links.smart.lost_by.corupted", "below": 1}, "metric"),
        ({"metric": "smart", "below": 1}, "metric"),
        ({"metric": 3, "below": 1}, "metric"),
        ({"link": "smrt"}, "link"),
        ({"secrecy": "total", "against": "smart"}, "secrecy"),
        ({"secrecy": "relative"}, "against"),
        ({"secrecy": "relative", "against": "legitimate"}, "against"),
        ({"synchronised": "smart"}, "by"),
        ({"synchronised": "smart", "by": 50}, "by"),
        ({"synchronised": "smart", "by": 9, "since": 10}, "by"),
        ({"synchronised": "smart", "by": -1}, "by"),
        ({"metric": ERROR, "blow": 1.0}, "blow"),
    ],
    ids=str,
)  # fmt: skip
def test_a_mistake_of_an_expectation_is_named(expectation: dict[str, Any], place: str, golden: Golden) -> None:
    """Its path, what was found, what was expected."""
    mistakes = mistakes_of(expecting, expectation)
    assert f"expect.0.{place}" in places_of(mistakes)
    golden("check", mistakes)


AT_ONCE: dict[str, tuple[list[dict[str, Any]], set[str]]] = {
    "of tables": (
        [
            {"metric": "smart.mean_eror", "near": 1, "slots": [3, 99]},
            {"metric": ERROR, "below": "1", "quantile": 2.0},
            {"secrecy": "relative", "by": 3},
            {"synchronised": "nobody", "by": 99, "since": 100},
        ],
        {"0.within", "1.below", "1.quantile", "2.by", "2.against", "3.by"},
    ),
    "across tables": (
        [
            {"metric": "smart.mean_eror", "below": 1, "slots": [3, 99]},
            {"secrecy": "relative", "against": "nobody"},
            {"link": "nobody"},
            {"synchronised": "nobody", "by": 99, "since": 98},
        ],
        {"0.metric", "0.slots", "1.against", "2.link", "3.synchronised", "3.by", "3.since"},
    ),
}


@pytest.mark.parametrize("name", AT_ONCE)
def test_all_mistakes_of_expectations_are_named_at_once(name: str) -> None:
    """Wrong entries of several tables, and wrong combinations of valid entries; then all that other tables show."""
    expectations, paths = AT_ONCE[name]
    mistakes = mistakes_of(expecting, *expectations)
    assert sorted(line.partition(": ")[0] for line in mistakes) == sorted(f"expect.{path}" for path in paths)


def test_without_eavesdroppers_there_is_nobody_to_be_secret_from() -> None:
    """The message says so, and offers no empty choice."""
    tables = {**CERTAIN, "expect": [{"secrecy": "perfect", "against": "smart"}]}
    del tables["eavesdroppers"]
    with pytest.raises(ScenarioError, match="there is no eavesdropper; add one"):
        parse(tomli_w.dumps(tables), "scenario")


@pytest.mark.parametrize(
    ("quantile", "least"), [(0.9, 10), (0.1, 10), (0.5, 2), (0.99, 100), (0.95, 20), (0.999, 1000)]
)
def test_a_quantile_needs_a_trial_beyond_it(quantile: float, least: int) -> None:
    """The least number of trials is 1 over the fraction of trials beyond the quantile."""
    expectation = {"metric": ERROR, "below": 1.0, "quantile": quantile}
    assert expecting(expectation, trials=least).trials == least
    (mistake,) = mistakes_of(expecting, expectation, trials=least - 1)
    assert mistake.partition(" (line")[0].endswith(f"expected trials = {least} or more")


@pytest.mark.parametrize(
    ("expectation", "text", "holds", "fails"),
    [
        ({"metric": ERROR, "above": 1, "below": 2.5}, f"{ERROR} below 2.5 and above 1", (1.1, 2.4), (1, 2.5)),
        ({"metric": ERROR, "near": 2, "within": 0.5}, f"{ERROR} near 2 within 0.5", (1.5, 2.5), (1.49, 2.51)),
        (
            {"metric": ERROR, "near": -2, "within_relative": 0.25, "slots": [10, 20], "quantile": 0.9},
            f"0.9 quantile of {ERROR} over slots 10 to 19 near -2 within 0.25 of it",
            (-2.5, -1.5),
            (-2.51, -1.49),
        ),
        (
            {"metric": "links.smart.lost_by.late", "below": 3},
            "links.smart.lost_by.late below 3",
            (2,),
            (3, float("nan")),
        ),
    ],
)
def test_what_is_wanted_of_a_metric(
    expectation: dict[str, Any], text: str, holds: tuple[float, ...], fails: tuple[float, ...]
) -> None:
    """The sentence, and the metrics that are as wanted: bounds are not, distances are."""
    (made,) = expecting(expectation).expect
    assert made.text == text
    assert text.endswith(made.wanted)
    assert all(made.holds(hold) for hold in holds)
    assert not any(made.holds(fail) for fail in fails)


@pytest.mark.parametrize(
    ("expectation", "text"),
    [
        ({"link": "smart"}, "link smart within its confidence interval"),
        ({"secrecy": "perfect", "against": "smart"}, "perfect secrecy against smart promised by theory and shown by the run"),
        ({"synchronised": "legitimate", "by": 9}, "legitimate synchronised by slot 9"),
        ({"synchronised": "legitimate", "by": 9, "since": 5}, "legitimate synchronised by slot 9, since slot 5"),
    ],
)  # fmt: skip
def test_what_is_wanted_of_other_things(expectation: dict[str, Any], text: str) -> None:
    """Each is a sentence."""
    assert expecting(expectation).expect[0].text == text
