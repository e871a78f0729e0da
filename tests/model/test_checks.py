"""Parameters of the built-in classes as a scenario gives them: right ones are accepted, each wrong one is named."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from evedrop.model.checks import as_toml, flag_mistakes, is_number, whole_number_mistakes
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.delays import DELAY_MODELS, LONGEST, DelayModel, delay_of
from evedrop.model.links import LOSS_MODELS, loss_of
from evedrop.model.links.loss_model import LossModel, Pooled
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.model.schemes import SCHEMES
from tests.model.test_controllers import assigned

KINDS: dict[str, Mapping[str, type[Any]]] = {
    "loss": LOSS_MODELS,
    "delay": DELAY_MODELS,
    "scheme": SCHEMES,
    "controller": CONTROLLERS,
}
EXAMPLES = [(kind, name) for kind, classes in KINDS.items() for name in classes]


@pytest.mark.parametrize(("kind", "name"), EXAMPLES)
def test_the_example_of_every_class_has_no_mistakes(kind: str, name: str) -> None:
    """Neither has a table without any parameters: what is missing is another check's affair."""
    kind_ = KINDS[kind][name]
    assert kind_.mistakes({}) == []
    assert [kind_.mistakes({entry: value}) for entry, value in kind_.parameters.items()] == [[]] * len(kind_.parameters)


def test_a_whole_number_beyond_float64_is_none() -> None:
    """A file can have one of 4096 bits, and the mathematics cannot use it."""
    largest = int(sys.float_info.max)
    assert [is_number(sign * number) for sign in (1, -1) for number in (largest, 10**400)] == [True, False] * 2


NUMBER = "expected a number from 0 to 1"
MANY = [[1.0 / 65] * 65] * 65
WRONG: list[tuple[str, str, dict[str, Any], list[tuple[str, str]]]] = [
    ("loss", "bernoulli", {"quality": 1.5}, [("quality", f"is 1.5; {NUMBER}")]),
    ("loss", "bernoulli", {"quality": True}, [("quality", f"is true; {NUMBER}")]),
    ("loss", "gilbert-elliott", {"p": -0.1, "bad": "x"}, [("p", f"is -0.1; {NUMBER}"), ("bad", f'is "x"; {NUMBER}')]),
    ("loss", "gilbert-elliott", {"p": 0.0, "r": 0.0}, [("p", "and r are both 0, so the link stays in an unknown state")]),
    ("loss", "pattern", {"outcomes": "102"}, [("outcomes", 'is "102"; expected a word of 0 (lost) and 1 (delivered)')]),
    ("loss", "pattern", {"outcomes": ""}, [("outcomes", 'is ""; expected a word of 0 (lost) and 1 (delivered)')]),
    ("loss", "markov", {"transitions": 3}, [("transitions", "is not a matrix; expected a list of rows")]),
    ("loss", "markov", {"transitions": []}, [("transitions", "is not a matrix; expected a list of rows")]),
    ("loss", "markov", {"transitions": [[1.0], 3]}, [("transitions", "is not a matrix; expected a list of rows")]),
    ("loss", "markov", {"transitions": [[1.0, 0.0]]}, [("transitions", "is not square, or has more than 64 rows")]),
    ("loss", "markov", {"transitions": MANY}, [("transitions", "is not square, or has more than 64 rows")]),
    (
        "loss",
        "markov",
        {"transitions": [[0.5, 0.4], [1.5, -0.5]]},
        [
            ("transitions", "row 0 sums to 0.9; expected 1"),
            ("transitions", "row 1 is [1.5, -0.5]; expected numbers from 0 to 1"),
        ],
    ),
    ("loss", "markov", {"transitions": np.eye(2).tolist()}, [("transitions", "has several recurrent classes; expected a")]),
    ("loss", "markov", {"loss": 0.5}, [("loss", "is 0.5; expected numbers from 0 to 1, one for each state")]),
    ("loss", "markov", {"loss": [0.5, 2.0]}, [("loss", "is [0.5, 2.0]; expected numbers from 0 to 1, one for each")]),
    (
        "loss",
        "markov",
        {"transitions": [[0.5, 0.5], [0.5, 0.5]], "loss": [0.5]},
        [("loss", "is [0.5]; expected 2 numbers from 0 to 1, one for each state")],
    ),
    ("delay", "constant", {"value": math.inf}, [("value", "is inf; expected a number from 0 to 1000000")]),
    ("delay", "normal", {"mean": "x"}, [("mean", 'is "x"; expected a number from 0 to 1000000')]),
    ("delay", "pareto", {"least": -1.0}, [("least", "is -1.0; expected a number from 0 to 1000000")]),
    ("delay", "pareto", {"shape": 0.01}, [("shape", "is 0.01; expected a number from 0.1 to 1000")]),
    ("delay", "trace", {"values": []}, [("values", "is not a list of 1 to 900000 delays; expected values = [0.5, 2.0]")]),
    ("delay", "trace", {"values": [0.5, True]}, [("values.1", "is not a delay; expected a number from 0 to 1000000")]),
    ("scheme", "innovation", {"state_probability": 2}, [("state_probability", f"is 2; {NUMBER}")]),
    ("scheme", "scheduled", {"threshold": 0}, [("threshold", "is 0; expected a whole number from 1 to 1000000")]),
    ("scheme", "encrypted-schedule", {"threshold": 1.0}, [("threshold", "is 1.0; expected a whole number from 1 to")]),
    ("controller", "mpc", {"horizon": 0}, [("horizon", "is 0; expected a whole number from 1 to 1000, such as")]),
    ("controller", "mpc", {"soft": 0}, [("soft", "is 0; expected a number above 0, such as soft = 1000.0")]),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "given", "expected"), WRONG)
def test_every_wrong_parameter_is_named(kind: str, name: str, given: dict[str, Any], expected: list[Any]) -> None:
    """With the value found and the values expected, in the order of the parameters."""
    mistakes = KINDS[kind][name].mistakes(given)
    assert [entry for entry, _ in mistakes] == [entry for entry, _ in expected]
    for (_, sentence), (_, message) in zip(mistakes, expected, strict=True):
        assert sentence.startswith(message)


class Own(LossModel):
    """A loss model of somebody else: good in even slots, and worse in odd ones; fates of slots are independent."""

    parameters = {"even": 0.9, "odd": 0.3}  # noqa: RUF012 - as its author would write it
    quality = 0.6

    def quality_at(self, slots: range) -> Floats:
        """0.9 or 0.3."""
        return np.array([0.3 if k % 2 else 0.9 for k in slots])

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Lost where the uniform number reaches the slot's quality."""
        slots = range(first, first + len(uniforms))
        return (uniforms[:, 0, :] >= self.quality_at(slots)[:, None]).view(np.uint8)


class Slow(DelayModel):
    """A delay model of somebody else, without parameters."""

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """One slot."""
        return np.ones_like(numbers)

    def arrived(self, lag: int) -> float | None:
        """After one slot."""
        return float(lag >= 1)


def test_a_class_without_checks_of_its_own_has_no_mistakes() -> None:
    """Its author need not write any; pooled links are checked one by one."""
    given = {"even": "anything"}
    assert (
        Own.mistakes(given)
        == Slow.mistakes(given)
        == Pooled.mistakes(given)
        == CONTROLLERS["lqr"].mistakes(given)
        == []
    )
    assert Own().quality_at(range(2)).tolist() == [0.9, 0.3]


def test_the_rate_of_independent_losses_scatters_as_binomials_do() -> None:
    """Of a model without a chain: Σ q_k (1 − q_k) / c², as 20,000 trials confirm within 5 standard errors."""
    model, count, trials = Own(), 7, 20_000
    expected = (4 * 0.9 * 0.1 + 3 * 0.3 * 0.7) / count**2
    assert model.rate_variance(range(count)) == pytest.approx(expected, rel=1e-12)
    rates = (model.fates(0, np.random.default_rng(1).random((count, 1, trials))) == 0).mean(axis=0)
    assert abs(rates.var() - expected) < 5 * expected * math.sqrt(2 / trials)


def test_a_normal_delay_without_variance_is_constant() -> None:
    """It has arrived in the slot in which its mean ends, and never before."""
    exact = delay_of({"model": "normal", "mean": 2.5, "standard_deviation": 0.0})
    assert [exact.arrived(lag) for lag in range(4)] == [0.0, 0.0, 1.0, 1.0]
    assert exact.delays(0, np.array([[-3.0, 3.0]])).tolist() == [[2.5, 2.5]]


def test_a_delay_is_cut_to_the_longest() -> None:
    """A heavy tail has no end."""
    tail = delay_of({"model": "pareto", "least": 1.0, "shape": 0.1})
    assert tail.delays(0, np.array([[0.0, 1.0 - 1e-9]])).tolist() == [[1.0, LONGEST]]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({}, "{}"),
        ({"a": [1, 2.5], "b": {"c": "ä"}}, '{ a = [1, 2.5], b = { c = "ä" } }'),
        (False, "false"),
        ("x" * 100, json.dumps("x" * 81)[:80] + "…"),
        ([1] * 100, "[" + "1, " * 26 + "1…"),
    ],
)
def test_a_value_is_shown_as_a_scenario_has_it(value: object, text: str) -> None:
    """A long one is cut."""
    assert as_toml(value) == text


def test_checks_of_flags_and_counts() -> None:
    """A parameter that is not given has no mistake."""
    flags = {"once": True, "random_start": 1}
    assert flag_mistakes(flags, "once", "random_start", "absent") == [("random_start", "is 1; expected true or false")]
    assert whole_number_mistakes({"count": 1_000_000}, "count", 1, 1_000_000) == []
    assert [entry for entry, _ in whole_number_mistakes({"count": 1_000_001}, "count", 1, 1_000_000)] == ["count"]


def test_losses_of_states_are_looked_up_in_either_way() -> None:
    """With few marks each is compared, with many they are searched: the same states, at a seed, as of a chain twice as large."""
    small = {"model": "markov", "transitions": [[0.6, 0.4], [0.3, 0.7]], "loss": [0.0, 1.0]}
    many = 8
    # Every state has many copies, which differ only in how likely each copy is; the loss of a copy is that of its state.
    fraction = np.arange(1.0, many + 1) / np.arange(1.0, many + 1).sum()
    copies = np.kron(np.array(small["transitions"]), np.ones((many, 1)) * fraction)
    large = {"model": "markov", "transitions": copies.tolist(), "loss": np.repeat([0.0, 1.0], many).tolist()}
    numbers = np.random.default_rng(4).random((200, 2, 50))
    assert LOSS_MODELS["markov"].mistakes({name: large[name] for name in ("transitions", "loss")}) == []
    assert np.array_equal(loss_of(small).fates(0, numbers), loss_of(large).fates(0, numbers))


def test_a_solver_that_is_broken_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed, but not as it was built: the reason and the remedy."""
    broken = ModuleType("osqp")
    broken.__spec__ = sys.modules["osqp"].__spec__
    monkeypatch.setitem(sys.modules, "osqp", broken)
    ((entry, sentence),) = CONTROLLERS["mpc"].objections(assigned())
    assert entry == "strategy"
    assert sentence.startswith(
        "is mpc, whose solver is broken (importing osqp raised AttributeError: module 'osqp' has no"
    )
    assert sentence.endswith("expected pip install --force-reinstall osqp first, or the strategy lqr")
