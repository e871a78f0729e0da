"""Whether errors have a heavy tail, against exact second moments of scalar errors, event by event."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.reference_form import ReferenceForm
from evedrop.model.theory.closed_forms import ChainForm, SensorChain, always_sent, encrypted_schedule, scheduled


def process_of(a: float) -> Process:
    """A scalar process."""
    return Process(np.array([[a]]), np.eye(1), np.eye(1))


def spread_of_reference(a: float, received: float, acknowledged: tuple[float, float], slots: int) -> float:
    """E P² / (E P)² in the last slot, from the moments of (1, P, R, P², P R, R²), which follow each other linearly."""
    unheard = acknowledged[1]
    square = a * a
    # (P, R) ← new rows of (P⁻, R⁻): what becomes of both, with the probability of the event.
    events = [(received, ("R", "R")), (unheard, ("P", "P")), (1.0 - received - unheard, ("P", "R"))]
    first_moments, two = {"P": 0.0, "R": 0.0}, {"PP": 0.0, "PR": 0.0, "RR": 0.0}
    for k in range(slots):
        q = 1.0
        before = first_moments, two
        P1 = square * before[0]["P"] * (k > 0) + q
        R1 = square * before[0]["R"]
        first = {"P": P1, "R": R1}
        second = {
            "PP": square**2 * two["PP"] + 2 * q * square * first_moments["P"] + q * q,
            "PR": square**2 * two["PR"] + q * square * first_moments["R"],
            "RR": square**2 * two["RR"],
        }
        first_moments, two = {"P": 0.0, "R": 0.0}, {"PP": 0.0, "PR": 0.0, "RR": 0.0}
        for chance, (p, r) in events:
            first_moments["P"] += chance * first[p]
            first_moments["R"] += chance * first[r]
            for name, (x, y) in {"PP": (p, p), "PR": (p, r), "RR": (r, r)}.items():
                two[name] += chance * second["".join(sorted((x, y)))]
    return two["PP"] / first_moments["P"] ** 2


def spread_of_chain(a: float, chain: SensorChain, slots: int) -> float:
    """E P² / (E P)² in the last slot, from the moments of each state; scaled, so that nothing overflows."""
    distribution, first_moment, two = chain.start, np.zeros(len(chain.start)), np.zeros(len(chain.start))
    scale = 1.0
    for _ in range(slots):
        q = 1.0 / scale
        grown, squared = (
            a * a * first_moment + q * distribution,
            a**4 * two + 2.0 * q * a * a * first_moment + q * q * distribution,
        )
        first_moment, two = grown @ chain.carried, squared @ chain.carried
        distribution = distribution @ (chain.carried + chain.reset)
        by = max(1.0, float(first_moment.sum()))
        first_moment, two, scale = first_moment / by, two / by**2, scale * by
    return float(two.sum() / first_moment.sum() ** 2)


@pytest.mark.parametrize("a", [0.9, 1.0, 1.05, 1.3])
@pytest.mark.parametrize(
    ("received", "acknowledged"),
    [
        (0.8, (0.72, 0.18)),
        (0.8, (0.72, 0.0)),
        (0.0, (0.0, 0.8)),
        (0.3, (0.3, 0.0)),
        (0.95, (0.9, 0.01)),
        (0.0, (0.0, 0.0)),
    ],
)
def test_references(a: float, received: float, acknowledged: tuple[float, float]) -> None:
    """A reader of state-secrecy codes: its relative second moment is unbounded exactly where it is said to be."""
    infinite_variance = ReferenceForm(process_of(a), 80, received, acknowledged).infinite_variance
    short, long = (spread_of_reference(a, received, acknowledged, slots) for slots in (150, 300))
    assert infinite_variance == (long > 2.0 * short)


@pytest.mark.parametrize("a", [0.9, 1.0, 1.1, 1.5])
@pytest.mark.parametrize(
    "chain",
    [
        scheduled(3, 0.9, (0.8, 0.1)),
        scheduled(3, 0.2, (0.2, 0.6)),
        encrypted_schedule(3.0, 0.8, (0.7, 0.2)),
        encrypted_schedule(3.0, 0.0, (0.0, 0.8)),
        always_sent(0.3),
        always_sent(0.0),
        always_sent(1.0),
    ],
    ids=["scheduled", "far", "encrypted", "reads nothing", "plain", "hears nothing", "hears all"],
)
def test_chains(a: float, chain: SensorChain) -> None:
    """The same for receivers of schedules by holding time."""
    infinite_variance = ChainForm(process_of(a), 80, chain).infinite_variance
    if chain.carried.any():
        short, long = (spread_of_chain(a, chain, slots) for slots in (150, 300))
        assert infinite_variance == (long > 2.0 * short)
    else:
        assert not infinite_variance
