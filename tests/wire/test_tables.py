"""`[[expect]]` of a wire file: its bounds, its words, and its mistakes."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from evedrop.wire.file import wire_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.tables import WireExpectTable, WireFile, changed_settings
from tests.builders import mistakes_of


def expecting(**table: Any) -> WirePlan:
    """A wire with one link, scan, and this expectation."""
    link = {"name": "scan", "from": "robot", "to": "base"}
    return wire_of({"side": {"robot": {}, "base": {}}, "link": [link], "expect": [table]})


@pytest.mark.parametrize(
    ("table", "subject", "text"),
    [
        ({"link": "scan"}, "scan", "link scan within the 99 % bounds of its model"),
        ({"metric": "scan.delivery", "below": 0.9}, "scan", "scan.delivery below 0.9"),
        ({"metric": "a.heard", "above": 0, "below": 5}, "a", "a.heard below 5 and above 0"),
        (
            {"metric": "scan.latency", "quantile": 0.99, "below": "20 ms"},
            "scan",
            "0.99 quantile of scan.latency below 0.02",
        ),
        ({"metric": "scan.latency", "quantile": 0.5, "above": 0.5}, "scan", "0.5 quantile of scan.latency above 0.5"),
    ],
)
def test_an_expectation_in_words(table: dict[str, Any], subject: str, text: str) -> None:
    """Its link, and the part of a sentence that says what is expected; a length of time is in seconds."""
    expectation = WireExpectTable.model_validate(table)
    assert (expectation.subject, expectation.text) == (subject, text)


def test_both_bounds_hold_together() -> None:
    """Nothing outside of them does."""
    table = WireExpectTable.model_validate({"metric": "scan.gap_seconds", "above": "1 s", "below": "2 s"})
    assert [table.holds(value) for value in (0.5, 1.0, 1.5, 2.0, 2.5)] == [False, False, True, False, False]


@pytest.mark.parametrize("bound", [-0.5, float("inf"), float("nan"), True, "1"])
def test_a_bound_is_a_number_that_a_metric_can_reach(bound: Any) -> None:
    """Not below 0, not infinite, and a text only with a unit of time."""
    assert [mistake.partition(":")[0] for mistake in mistakes_of(expecting, metric="scan.delivery", below=bound)] == [
        "expect.0.below"
    ]


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"metric": "scan.delivery", "above": "20 ms"}, 'expect.0.above: is "20 ms", but scan.delivery is no time'),
        ({"metric": "scan.gap_messages", "below": "3 s"}, 'expect.0.below: is "3 s", but scan.gap_messages is no time'),
        ({"metric": "scan.heard", "below": 0}, "expect.0.below: is 0, and no value is below it"),
        ({"metric": "scan.delivery", "above": 1.0}, "expect.0.above: is 1, and no value is above it"),
        ({"metric": "scan.heard", "above": 5, "below": 5}, "expect.0.above: is 5, not less than below"),
    ],
)
def test_bounds_that_nothing_meets_are_refused(table: dict[str, Any], sentence: str) -> None:
    """And lengths of time for what is not one; each with the entry that is wrong."""
    (mistake,) = mistakes_of(expecting, **table)
    assert mistake.startswith(sentence)


def test_a_link_stands_alone() -> None:
    """Each other entry is named, and no others; None is as good as an entry that is not there."""
    sentences = mistakes_of(expecting, link="scan", metric="scan.heard", quantile=0.5, above=1)
    assert sorted(mistake.partition(":")[0] for mistake in sentences) == [
        "expect.0.above",
        "expect.0.metric",
        "expect.0.quantile",
    ]
    assert WireExpectTable.model_validate({"link": "scan", "metric": None, "below": None}).link == "scan"


def test_a_metric_is_that_of_a_link() -> None:
    """Without a link it is refused, as is one of an unknown link; the message names what there is."""
    assert mistakes_of(expecting, metric="delivery", below=1)[0].startswith(
        'expect.0.metric: is "delivery"; expected LINK.heard, '
    )
    (unknown,) = mistakes_of(expecting, metric="scam.heard", below=1)
    assert unknown == (
        'expect.0.metric: is "scam.heard", but there is no link scam; expected a metric or the name of scan; '
        "did you mean scan?"
    )
    (unknown,) = mistakes_of(expecting, link="sc.an")
    assert unknown.startswith('expect.0.link: is "sc.an", but there is no link sc.an; ')


def test_malformed_names_of_links_are_the_tables_matter() -> None:
    """The table itself refuses a value that is not a text; a text that names no link is an unknown link."""
    assert mistakes_of(expecting, metric=3)[0].startswith("expect.0.metric: is 3; expected a string")
    assert mistakes_of(expecting, metric=".heard", below=1)[0].startswith(
        'expect.0.metric: is ".heard", but there is no link '
    )
    assert mistakes_of(expecting, link="")[0].startswith('expect.0.link: is "", but there is no link ')


def test_a_rate_that_was_added_can_be_taken_away() -> None:
    """With the queue that came with it, although the change does not name it."""
    first = {"loss": {"model": "bernoulli", "quality": 0.9}}
    added = changed_settings(first, {"rate": 1000.0}, first)
    assert added == {"rate": 1000.0, "queue": 256_000.0}
    assert changed_settings({**first, **added}, {"rate": None}, first)["rate"] == 0.0


def test_a_query_waits_for_some_time() -> None:
    """Without any, replies would be lost at random."""
    with pytest.raises(ValidationError, match="query_seconds"):
        WireFile.model_validate({"query_seconds": 0.0})
