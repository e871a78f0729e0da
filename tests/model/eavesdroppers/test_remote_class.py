"""Remote classes of eavesdroppers: they check every answer of the class."""

from __future__ import annotations

import json
from typing import Any

import pytest

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.model.eavesdroppers.remote_class import RemoteCalls, RemoteClasses
from evedrop.model.theory.covariances import Outcomes

NAME, REGISTRY = "mine:Eve", "STRATEGIES"
GIVEN = {"threshold": 3}
FACTS = {"parameters": GIVEN, "own_outcomes": True}
OUTCOMES = {"predicted": 0.1, "state": 0.4, "misled": 0.25, "decoded": 0.25, "leaked": 0.0, "initial": 1.0}


def remote_class(facts: Any = FACTS, at: Any = OUTCOMES, **answers_: Any) -> Any:
    """The remote class of a class with these answers, without a process; at: its outcomes at μ_d = 0.5, μ_e = 0.25."""
    calls = RemoteCalls()
    answers: list[tuple[list[Any], Any]] = [
        (["class", REGISTRY], facts),
        *(([do, REGISTRY, GIVEN], value) for do, value in answers_.items()),
    ]
    answers += [(["outcomes", REGISTRY, GIVEN, 0.5], bool(at)), (["outcomes_at", REGISTRY, GIVEN, 0.5, 0.25], at)]
    calls.learn({json.dumps([NAME, *question]): {"is": value} for question, value in answers})
    return RemoteClasses(calls, REGISTRY)(NAME)


def test_it_says_what_the_class_says() -> None:
    """Facts and calls, in the types that the rest of the program expects."""
    facts = {**FACTS, "pools_links": True, "only_against": ["innovation", "it needs innovations"]}
    kind = remote_class(facts, mistakes=[["threshold", "is 3"]], streams=["noise"], betrayed=4, follows_gamma=False)
    assert (kind.__name__, kind.parameters, kind.pools_links, kind.inverts_noise) == ("Eve", GIVEN, True, False)
    assert kind.only_against == ("innovation", "it needs innovations")
    assert kind.mistakes(GIVEN) == [("threshold", "is 3")]
    assert kind.streams(GIVEN) == ("noise",)
    assert kind.betrayed(GIVEN) == 4
    assert kind.follows_gamma(GIVEN) is False
    assert remote_class({**FACTS, "only_against": [["a", "b"], "why"]}).only_against == (("a", "b"), "why")
    for nothing in (None, [["a", 3], "why"], [3, "why"], ["a", 3]):
        assert remote_class({**FACTS, "only_against": nothing}).only_against is None


@pytest.mark.parametrize(
    ("do", "value", "message"),
    [
        ("mistakes", [["threshold"]], "mistakes() is [['threshold']]; expected a list of (entry, what is wrong)"),
        ("mistakes", "none", "expected a list of (entry, what is wrong)"),
        ("streams", ["noise", 3], "streams() is ['noise', 3]; expected names of streams"),
        ("betrayed", -1, "betrayed() is -1; expected a slot, from 0 on, or None"),
        ("betrayed", True, "betrayed() is True; expected a slot, from 0 on, or None"),
        ("follows_gamma", 1, "follows_gamma() is 1; expected True or False"),
    ],
)
def test_an_answer_of_another_kind_is_refused(do: str, value: Any, message: str) -> None:
    """With the method and what it was expected to return."""
    with pytest.raises(NoAnswer) as refused:
        getattr(remote_class(**{do: value}), do)(GIVEN)
    assert message in str(refused.value)


@pytest.mark.parametrize("facts", [[], {"parameters": 3}, {}])
def test_a_class_that_declares_nothing_is_not_taken(facts: Any) -> None:
    """Its parameters must be a table."""
    with pytest.raises(NotRegistered, match="whose answer is invalid"):
        remote_class(facts)


def test_it_does_not_run() -> None:
    """The class runs in the process of its eavesdropper alone."""
    with pytest.raises(TypeError, match="Eve runs in the eavesdropper's process alone"):
        remote_class()()


@pytest.mark.parametrize("value", [None, [0.5], [0.5, 1.5], [0.5, float("nan")], [True, 0.5]])
def test_probabilities_of_use_are_probabilities(value: Any) -> None:
    """Two of them."""
    kind = remote_class({**FACTS, "takes": True, "own_outcomes": False}, use_probabilities=value)
    with pytest.raises(NoAnswer, match="expected two probabilities"):
        kind.use_probabilities(GIVEN)
    assert remote_class({**FACTS, "takes": True}, use_probabilities=[0.5, 1]).use_probabilities(GIVEN) == (0.5, 1)


@pytest.mark.parametrize("takes", [True, False])
def test_its_own_theory_is_asked_at_every_quality(takes: bool) -> None:
    """None if it has none."""
    kind = remote_class({**FACTS, "takes": takes})
    assert kind.outcomes(GIVEN, 0.5)(0.25) == Outcomes(**OUTCOMES)
    assert remote_class({**FACTS, "takes": takes}, at=None).outcomes(GIVEN, 0.5) is None


def test_without_a_theory_of_its_own_the_probabilities_of_use_give_the_outcomes() -> None:
    """As for a built-in class that uses every packet as the state."""
    kind = remote_class({**FACTS, "takes": True, "own_outcomes": False}, at=None, use_probabilities=[1.0, 1.0])
    naive = Naive.outcomes({}, 0.5)
    assert naive is not None
    assert kind.outcomes(GIVEN, 0.5)(0.25) == naive(0.25)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"misled": 0.5}, "that sum to 1"),
        ({"misled": 1.25, "state": -0.6}, "expected probabilities"),
        ({"misled": "0.25"}, "expected probabilities"),
        ({"other": 0.0}, "expected the probabilities predicted, state, misled, decoded, leaked, initial"),
    ],
)
def test_outcomes_that_are_no_probabilities_are_refused(change: dict[str, Any], message: str) -> None:
    """Of each entry, of their sum, and of no others."""
    with pytest.raises(NoAnswer) as refused:
        remote_class(at={**OUTCOMES, **change}).outcomes(GIVEN, 0.5)(0.25)
    assert message in str(refused.value)


def test_a_class_that_cannot_be_asked_is_not_registered() -> None:
    """With the reason why it gave no answer, or with what is wrong with its answer."""

    class Silent:
        """No class answers."""

        def call(self, *_: object) -> Any:
            """Never."""
            raise NoAnswer("it did not answer within 60 s")

    silent: Any = Silent()
    with pytest.raises(NotRegistered) as refused:
        RemoteClasses(silent, REGISTRY)(NAME)
    assert refused.value.why == (", and it did not answer within 60 s; expected a class that can be asked about itself")
