"""The growth of the error of a receiver that lacks the reference, and the warning where it has no bound."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.theory.closed_forms import growth_by_coin, growth_by_phases, most_coded
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import checked
from tests.builders import DRIFTING, UNSTABLE, tables_of
from tests.model.acknowledged_runs import MIXED
from tests.model.mixed_runs import covariances
from tests.model.slot_loop import STABLE

LEGITIMATE_RATES = (0.72, 0.02)
"""μ = 0.8, p = 0.1: a packet is acknowledged and received, and acknowledged and not received."""
NOTHING = Process(np.zeros((1, 1)), np.eye(1), np.eye(1))


@pytest.mark.parametrize("coded", [0, 1, 5])
@pytest.mark.parametrize("process", [MIXED, STABLE, UNSTABLE])
def test_the_factor_of_a_phase_solves_its_equations(process: Process, coded: int) -> None:
    """x_s = ρ²(P(next) x_{s+1} + P(stay) x_s) over the coded packets and the phase, which ends with a missed, forged one."""
    square, arrives = process.spectral_radius**2, sum(LEGITIMATE_RATES)
    stay = [1.0 - arrives] * coded + [1.0 - 0.8 - LEGITIMATE_RATES[1]]
    step = [arrives] * coded + [LEGITIMATE_RATES[1]]
    equations = np.eye(coded + 1) - square * (np.diag(stay) + np.diag(step[:-1], 1))
    right = np.zeros(coded + 1)
    right[-1] = square * step[-1]
    expected = np.linalg.solve(equations, right)[0]
    assert growth_by_phases(process, coded, 0.8, LEGITIMATE_RATES) == pytest.approx(expected)


def test_factors_at_the_edges() -> None:
    """Nothing is lost; nothing is remembered; no phase comes, or none ends in time; more than a double holds."""
    assert growth_by_coin(MIXED, 0.5, 0.8) == pytest.approx(1.44 * 0.6)
    assert growth_by_phases(MIXED, 3, 0.8, (0.8, 0.0)) == 0.0
    assert growth_by_phases(NOTHING, 3, 0.8, LEGITIMATE_RATES) == 0.0
    assert growth_by_phases(MIXED, math.inf, 0.8, LEGITIMATE_RATES) == math.inf
    assert growth_by_phases(MIXED, 3, 0.2, (0.1, 0.01)) == math.inf
    assert growth_by_phases(MIXED, 10**5, 0.8, LEGITIMATE_RATES) == math.inf


def test_the_most_coded_packets() -> None:
    """The last number whose factor is below 1; none if even a single phase is too much; any number if nothing grows."""
    for process in (MIXED, UNSTABLE):
        most = most_coded(process, 0.8, LEGITIMATE_RATES)
        assert (
            growth_by_phases(process, most, 0.8, LEGITIMATE_RATES)
            < 1.0
            <= growth_by_phases(process, most + 1.0, 0.8, LEGITIMATE_RATES)
        )
    assert most_coded(MIXED, 0.2, (0.1, 0.01)) == -1.0
    assert most_coded(DRIFTING, 0.8, LEGITIMATE_RATES) == most_coded(STABLE, 0.8, (0.8, 0.0)) == math.inf


def test_a_phase_after_each_acknowledgement_needs_no_coded_packet() -> None:
    """However long the next acknowledgement takes, when the error grows faster than they come."""
    process = Process(np.array([[2.1]]), np.eye(1), np.eye(1))
    assert growth_by_phases(process, 0, 0.8, LEGITIMATE_RATES) == pytest.approx(4.41 * 0.02 / (1.0 - 4.41 * 0.18))
    assert growth_by_phases(process, 1, 0.8, LEGITIMATE_RATES) == math.inf
    assert most_coded(process, 0.8, LEGITIMATE_RATES) == 0.0


def test_the_error_grows_with_the_code_of_the_project_too() -> None:
    """A forged reference, then coded packets that all arrive: 1.44-fold a slot in the end, whatever is acknowledged."""
    slots = 40
    acks = np.random.default_rng(6).random((slots, 30)) < 0.5
    heard, plain = np.ones((slots, 30), bool), np.zeros((slots, 30), bool)
    acks[:2], heard[1] = True, False
    traces = np.einsum("kiir->kr", covariances(MIXED, plain, acks, heard))
    assert traces[20:] == pytest.approx(1.44 * traces[19:-1], rel=1e-3)


@pytest.mark.parametrize(
    ("spec", "entry"),
    [
        ({"scheme": "random-code", "plain_probability": 0.3}, "plain_probability"),
        ({"scheme": "threshold-code", "lost_belief": 0.3, "assumed_quality": 0.8, "assumed_flip": 0.1}, "lost_belief"),
    ],
)
def test_the_remedy_is_the_bound(spec: dict[str, Any], entry: str) -> None:
    """The parameter it names bounds the error on the one side, and not on the other."""
    lost = scheme_of(MIXED, spec).lost_reference(0.8, LEGITIMATE_RATES)
    assert lost is not None
    assert lost.growth >= 1.0
    assert lost.remedy.startswith(entry)
    bound = float(lost.remedy.split()[-1])
    growths = []
    for value in (bound - 1e-5, bound + 1e-5):
        lost_reference = scheme_of(MIXED, {**spec, entry: value}).lost_reference(0.8, LEGITIMATE_RATES)
        assert lost_reference is not None
        growths.append(lost_reference.growth)
    below, above = growths
    assert (below < 1.0 <= above) if entry == "lost_belief" else (above < 1.0 <= below)
    poor = scheme_of(MIXED, spec).lost_reference(0.2, (0.18, 0.08))
    assert poor is not None
    assert poor.remedy == "the link is better"


def test_which_schemes_have_references() -> None:
    """These four; a sensor that expects no flips never sends the state again, and one that expects only forged ones always."""
    with_references = {name for name in SCHEMES if SCHEMES[name].lost_reference is not Scheme.lost_reference}
    assert with_references == {"acknowledged", "open-loop", "random-code", "threshold-code"}
    assert scheme_of(MIXED, {"scheme": "plain"}).lost_reference(0.8, LEGITIMATE_RATES) is None
    threshold = {"scheme": "threshold-code", "lost_belief": 0.1, "assumed_quality": 0.8, "assumed_flip": 0.0}
    lost = scheme_of(MIXED, threshold).lost_reference(0.8, LEGITIMATE_RATES)
    assert lost is not None
    assert (lost.growth, lost.remedy.split(":")[0]) == (math.inf, "assumed_flip is above 0")
    always = scheme_of(MIXED, {**threshold, "assumed_quality": 0.0, "assumed_flip": 0.5}).lost_reference(
        0.8, LEGITIMATE_RATES
    )
    assert always is not None
    assert always.growth == growth_by_phases(MIXED, 0, 0.8, LEGITIMATE_RATES)


def attacked(process: Process, attack: dict[str, Any], **encoding: Any) -> dict[str, Any]:
    """A scenario whose acknowledgements are attacked."""
    return tables_of(
        Process(process.A, process.Q, np.eye(process.n)),
        slots=40,
        encoding=encoding,
        acknowledgements={"link": {"quality": 1.0}, **attack},
        legitimate={"link": {"quality": 0.8}},
    )


def test_a_user_that_loses_the_reference_for_too_long_is_a_warning() -> None:
    """With the bound and the remedy; not if nothing is forged, nor for a stable process, a parameter inside, or another link."""
    flips = {"attack": "flip", "flip": 0.1}
    outside = {"scheme": "random-code", "plain_probability": 0.3}
    (warning,) = warnings_of(checked(attacked(MIXED, flips, **outside), "it"))
    assert (
        "grows without bound unless plain_probability exceeds 0.381944: acknowledgements of packets that it missed"
        in warning
    )
    assert "link quality 0.8 and spectral radius 1.2" in warning
    (warning,) = warnings_of(checked(attacked(MIXED, flips, scheme="acknowledged"), "it"))
    assert "unless random-code or threshold-code is used" in warning
    (warning,) = warnings_of(checked(attacked(MIXED, {"attack": "forge"}, scheme="open-loop"), "it"))
    assert "grows without bound" in warning
    varying = attacked(MIXED, flips, **outside)
    varying["legitimate"] = {"link": {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}}}
    for quiet in (
        attacked(MIXED, flips, scheme="random-code", plain_probability=0.4),
        attacked(MIXED, {"attack": "none"}, **outside),
        attacked(MIXED, {"attack": "flip", "flip": 0.0}, **outside),
        attacked(STABLE, flips, **outside),
        attacked(STABLE, flips, scheme="acknowledged"),
        attacked(MIXED, flips, scheme="scheduled", threshold=2),
        varying,
    ):
        assert warnings_of(checked(quiet, "it")) == []
