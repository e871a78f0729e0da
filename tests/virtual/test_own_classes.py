"""Classes that are not built in take part in simulated runs."""

from __future__ import annotations

import pytest

from evedrop.cli.simulated import program
from evedrop.scenario.tables import Scenario
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase, case_of
from evedrop.virtual.own_classes import LOSS_MODEL, SCHEME, STRATEGY, EverySecond

SCENARIO = Scenario(
    {
        "title": "Own classes",
        "slots": 20,
        "process": {"A": [[0.9]], "Q": [[0.01]], "initial_covariance": [[1.0]]},
        "encoding": {"scheme": SCHEME},
        "legitimate": {"link": {"loss": {"model": LOSS_MODEL, "good": 0.9}}},
        "eavesdroppers": {"eve": {"strategy": STRATEGY, "link": {"quality": 0.9}}},
    }
)


def test_a_run_with_own_classes_keeps_its_promises() -> None:
    """With the same events again, although a process of its own answers for the eavesdropper's class."""
    runs = [play_case(SimulatedCase(1, SCENARIO, ()), program) for _ in range(2)]
    assert [played.misses for played in runs] == [(), ()]
    assert runs[0].run.digest == runs[1].run.digest


@pytest.mark.campaign
def test_own_classes_are_drawn() -> None:
    """Each of them."""
    texts = [case_of(seed).to_text() for seed in range(1, 150)]
    for name in (SCHEME, LOSS_MODEL, STRATEGY):
        assert any(name in text for text in texts), name


def test_a_loss_model_refuses_what_is_no_probability() -> None:
    """A router that is given one by a wrong brief says so, before the run."""
    assert [entry for entry, _ in EverySecond.mistakes({"good": "half"})] == ["good"]
    assert EverySecond.mistakes({"good": 0.9}) == []
