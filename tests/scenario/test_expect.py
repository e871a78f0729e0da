"""`[[expect]]` in a scenario: what is refused, how it is said, and the sentence it becomes."""

from __future__ import annotations

from typing import Any

import pytest
import tomli_w

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import parse
from evedrop.scenario.tables import Scenario
from tests.builders import mistakes_of, scalar_tables

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
    ("expectation", "message"),
    [
        ({}, 'metric: is missing; expected metric = "legitimate.mean_squared_error", or one of link, secrecy, synchronised'),
        ({"by": 3}, 'synchronised: is missing; expected synchronised = "legitimate"'),
        ({"against": "smart"}, 'secrecy: is missing; expected secrecy = "relative"'),
        ({"metric": ERROR, "below": 1.0, "link": "smart"}, "link: is given together with metric; expected one of metric, link"),
        ({"secrecy": "relative", "metric": ERROR}, "secrecy: is given together with metric; expected one of metric, link, sec"),
        ({"link": "smart", "below": 1.0}, "below: is set, but link has no such entry; remove the line"),
        ({"synchronised": "smart", "by": 9, "slots": [0, 9]}, "slots: is set, but synchronised has no such entry"),
        ({"metric": ERROR}, "below: is missing, and so is above; add below, above or near"),
        ({"metric": ERROR, "within": 1.0}, "within: is set without near; expected near = 0.01 as well"),
        ({"metric": ERROR, "within_relative": 0.1, "below": 1.0}, "within_relative: is set without near"),
        ({"metric": ERROR, "near": 1.0}, "within: is missing; expected within = 0.002, or within_relative = 0.1"),
        ({"metric": ERROR, "near": 1, "within": 1, "within_relative": 1}, "within_relative: is given together with within"),
        ({"metric": ERROR, "near": 0, "within_relative": 0.1}, "within_relative: is set, but any fraction of near = 0"),
        ({"metric": ERROR, "near": 1, "within": -1}, "within: is -1; expected a number at least 0"),
        ({"metric": ERROR, "near": 1, "within": "a bit"}, 'within: is "a bit"; expected a number, such as 0.002'),
        ({"metric": ERROR, "above": 2.0, "below": 1.0}, "above: is 2.0, and below is 1.0; expected above < below"),
        ({"metric": ERROR, "below": 1, "slots": 9}, "slots: is 9; expected a list, such as [100, 200]"),
        ({"metric": ERROR, "below": 1, "slots": [1, "x"]}, 'slots.1: is "x"; expected a whole number'),
        ({"metric": ERROR, "below": 1, "slots": [9]}, "slots: is [9]; expected two slots [from, to], 0 ≤ from < to"),
        ({"metric": ERROR, "below": 1, "slots": [9, 9]}, "slots: is [9, 9]; expected two slots [from, to], 0 ≤ from"),
        ({"metric": ERROR, "below": 1, "slots": [-1, 9]}, "slots: is [-1, 9]; expected two slots"),
        ({"metric": ERROR, "below": 1, "slots": [9, 51]}, "slots: is [9, 51]; expected from < to ≤ slots, which is 50"),
        ({"metric": ERROR, "below": 1, "quantile": 1.0}, "quantile: is 1.0; expected a number between 0 and 1"),
        ({"metric": ERROR, "below": 1, "quantile": 0}, "quantile: is 0; expected a number between 0 and 1"),
        ({"metric": ERROR, "below": 1, "quantile": 0.99}, "quantile: is 0.99 of 12 trials; expected trials = 100 or mo"),
        ({"metric": "smart.mean_trace_covariance", "below": 1, "quantile": 0.5}, "quantile: is set, but smart.mean_trac"),
        ({"metric": "links.smart.lost", "below": 1, "quantile": 0.5}, "quantile: is set, but a link's account is of the"),
        ({"metric": "links.smart.lost", "below": 1, "slots": [0, 9]}, "slots: is set, but a link's account is of the wh"),
        ({"metric": "links.smart.lots", "below": 1}, "did you mean links.smart.lost?"),
        ({"metric": "links.nobody.lost", "below": 1}, 'metric: is "links.nobody.lost"; expected RECEIVER (legitimate, s'),
        ({"metric": "links.smart.lost_by.2", "below": 1}, 'metric: is "links.smart.lost_by.2"; expected RECEIVER'),
        ({"metric": "smart", "below": 1}, 'metric: is "smart"; expected RECEIVER (legitimate, smart).METRIC (mean_sq'),
        ({"metric": 3, "below": 1}, "metric: is 3; expected a string"),
        ({"link": "smrt"}, 'link: is "smrt"; expected legitimate or smart; did you mean smart?'),
        ({"secrecy": "total", "against": "smart"}, 'secrecy: is "total"; expected perfect or relative'),
        ({"secrecy": "relative"}, "against: is missing; expected the name of an eavesdropper"),
        ({"secrecy": "relative", "against": "legitimate"}, 'against: is "legitimate"; expected smart'),
        ({"synchronised": "smart"}, "by: is missing; expected the last slot by which it must be synchronised, such as by = 40"),
        ({"synchronised": "smart", "by": 50}, "by: is 50; expected a slot of the run, 0 to 49"),
        ({"synchronised": "smart", "by": 9, "since": 10}, "by: is 9, before since, which is 10; expected since ≤ by"),
        ({"synchronised": "smart", "by": -1}, "by: is -1; expected a number at least 0"),
        ({"metric": ERROR, "blow": 1.0}, "blow: is not an entry of this table; did you mean below?"),
    ],
)  # fmt: skip
def test_a_mistake_of_an_expectation_is_named(expectation: dict[str, Any], message: str) -> None:
    """Its path, what was found, what was expected."""
    mistakes = mistakes_of(expecting, expectation)
    assert [line for line in mistakes if line.startswith("expect.0.") and message in line], mistakes


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
