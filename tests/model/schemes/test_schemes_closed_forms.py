"""The closed forms that built-in schemes state, and the conditions under which there is none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.model.acknowledgements import HeedRule
from evedrop.model.process import Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.theory.closed_forms import ClosedForm, Hijack, ReceiverConditions
from evedrop.model.theory.covariances import LARGEST_OPERATOR

STABLE = Process(np.array([[0.9, 0.3], [0.0, 0.8]]), np.eye(2), np.eye(2))
UNSTABLE = Process(np.array([[1.2, 0.1], [0.0, 0.5]]), np.eye(2), np.eye(2))
HEARS = ReceiverConditions(6, False, 0.7, None, (0.56, 0.16))
HIJACK = Hijack(0.8, 0.5, HeedRule(1, 0.5), lambda legitimate, served: float(served))  # noqa: ARG005 - the served eavesdropper's own
CHAINS = [("scheduled", "naive"), ("encrypted-schedule", "selective"), ("quantised-schedule", "selective")]


def form_of(
    scheme: str, receiver: str, conditions: ReceiverConditions, process: Process = STABLE, **more: Any
) -> ClosedForm | None:
    """The form that a scheme with its example parameters states."""
    made = scheme_of(process, {"scheme": scheme, **SCHEMES[scheme].parameters, **more})
    return made.closed_forms[receiver](made, conditions)


@pytest.mark.parametrize(
    ("scheme", "receiver"),
    [*CHAINS, ("quantised-schedule", "legitimate"), ("acknowledged", "reference"), ("open-loop", "reference")],
)
def test_each_form_needs_a_link_and_acknowledgements_that_stay_the_same(scheme: str, receiver: str) -> None:
    """Without either there is none; with both the expected error is finite in every slot, and no larger than without packets."""
    assert form_of(scheme, receiver, replace(HEARS, received=None, acknowledged=None)) is None
    assert form_of(scheme, receiver, replace(HEARS, acknowledged=None)) is None
    form = form_of(scheme, receiver, HEARS)
    assert form is not None
    assert form.traces.shape == (6,)
    assert form.growth is None
    assert not form.infinite_variance
    nothing = form_of(scheme, receiver, replace(HEARS, received=0.0, acknowledged=(0.0, 0.72)))
    assert nothing is not None
    assert (form.traces <= nothing.traces + 1e-12).all()
    assert form.limit <= nothing.limit + 1e-12


@pytest.mark.parametrize(("scheme", "receiver"), [*CHAINS, ("quantised-schedule", "legitimate")])
def test_a_chain_that_is_too_long_has_no_form(scheme: str, receiver: str) -> None:
    """A chain has a state for each slot up to the threshold; a limit that is too large to compute is NaN."""
    assert form_of(scheme, receiver, HEARS, threshold=LARGEST_OPERATOR + 1) is None
    long = form_of(scheme, receiver, HEARS, threshold=LARGEST_OPERATOR)
    assert long is not None
    assert math.isnan(long.limit) == (receiver != "legitimate")


def test_only_schedules_and_users_that_read_all_know_a_hijacked_sensor() -> None:
    """The others need the last packet alone. The chain of `scheduled` counts misses, and may be too long for that."""
    hijacked = replace(HEARS, hijack=HIJACK)
    for scheme, receiver in (
        ("encrypted-schedule", "selective"),
        ("acknowledged", "reference"),
        ("open-loop", "reference"),
    ):
        assert form_of(scheme, receiver, hijacked) is None
    assert form_of("quantised-schedule", "legitimate", hijacked) is not None
    form = form_of("scheduled", "naive", hijacked)
    assert form is not None
    assert form.limit != getattr(form_of("scheduled", "naive", HEARS), "limit", None)
    assert form_of("scheduled", "naive", hijacked, threshold=LARGEST_OPERATOR // 12 + 1) is None


def test_references_of_a_user_matter_only_if_they_are_forged() -> None:
    """Else it never misses one. A bound takes the place of a form where packets are independent of the state."""
    legitimate = replace(HEARS, legitimate=True, received=0.8, acknowledged=(0.72, 0.2))
    for scheme, bound in (("acknowledged", True), ("open-loop", False)):
        assert form_of(scheme, "legitimate", legitimate) is None
        form = form_of(scheme, "legitimate", replace(legitimate, forged=True))
        assert form is not None
        assert form.bound is bound
        lost = form_of(scheme, "reference", HEARS, UNSTABLE)
        assert lost is not None
        assert (lost.limit, lost.infinite_variance) == (math.inf, False)  # it grows alike in all trials
    kept = form_of("acknowledged", "reference", replace(HEARS, acknowledged=(0.7, 0.0)))
    assert kept is not None
    assert not kept.bound
