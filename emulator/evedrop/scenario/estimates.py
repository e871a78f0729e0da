"""Statements about a run before it starts: whether the estimator is bounded, and how much will be written."""

from __future__ import annotations

import math

import numpy as np

from evedrop.model.acknowledgements import rates_of
from evedrop.model.links.chain import Chain
from evedrop.model.local_filter import settled
from evedrop.model.theory.covariances import stability_bound
from evedrop.names import LEGITIMATE
from evedrop.scenario.plugins import sources_of
from evedrop.scenario.process_noise import is_singular
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of, replays_a_recording

_LARGE_BYTES = 1e9
_SHOWN_STATES = 3  # the largest matrix that is written out
_NEAR = 0.01  # relative to a covariance's largest entry


def warnings_of(scenario: Scenario, several: bool = False) -> list[str]:
    """Warnings that the user should read before the run; the run starts regardless.

    several: warn of what concerns only several trials, even if the scenario has one.

    Source: docs/mathematics/secrecy.md, secrecy and design (stability bound).
    """
    warnings = []
    expectation = expectations_of(scenario)[LEGITIMATE]
    alike = None if expectation.link is None else expectation.link.alike
    mu = 0.0 if alike is None else float(alike.quality[0])
    lost_reference = _reference_warnings(scenario, mu)
    explained = lost_reference and scenario.encoding.mu_d > stability_bound(scenario.process.process, mu)
    if math.isinf(expectation.limit) and not explained:
        warnings.append(
            f"the legitimate estimator's expected error grows without bound: {_why_unbounded(scenario, alike)}"
        )
    warnings += [*lost_reference, *_filter_warnings(scenario), *scenario.make_scheme().warnings()]
    warnings += _recording_warnings(scenario) if several or scenario.trials > 1 else []
    size = written_bytes(scenario)
    if size > _LARGE_BYTES:
        warnings.append(
            f"this run will write about {size / 1e9:.1f} GB of results; fewer slots or record_trials write less"
        )
    for module, source in sources_of(scenario.model_dump(mode="json")).items():
        if scenario.made_with.get(module, source) != source:
            warnings.append(f"the {module} is not the one these results were made with; its digests may differ")
    return warnings


def _why_unbounded(scenario: Scenario, alike: Chain | None) -> str:
    """Why the legitimate error grows without bound. alike: the losses of its link if they are independent and stay the same."""
    rho, mu_d = scenario.process.process.spectral_radius, scenario.encoding.mu_d
    if alike is None:
        return f"with spectral radius {rho:.6g} and state_probability {mu_d:g} the losses of its link last too long"
    mu = float(alike.quality[0])
    bound = stability_bound(scenario.process.process, mu)
    if mu_d > bound:
        return (
            f"with link quality {mu:g} and spectral radius {rho:.6g} the scheme {scenario.encoding.scheme} brings it the state "
            "too rarely or too roughly"
        )
    needed = f"{bound:.6g}" if math.isfinite(bound) else "∞"
    return (
        f"state_probability is {mu_d:g}, and with link quality {mu:g} and spectral radius {rho:.6g} it must exceed {needed}"
        + ("; no state_probability can, the link must be better" if bound >= 1.0 else "")
    )


def _reference_warnings(scenario: Scenario, mu: float) -> list[str]:
    """A warning if acknowledgements are forged and a legitimate estimator that lost the reference gets it back too late.

    mu: the quality of its link, 0 if that varies.

    Source: docs/mathematics/attacks.md, flipped acknowledgements.
    """
    table = scenario.acknowledgements
    if table is None or not scenario.forges_acknowledgements or mu == 0.0:
        return []
    rates = rates_of(table.attack, mu, 1.0, table.link.quality, table.flip or 0.0)
    scheme = scenario.make_scheme()
    lost = scheme.lost_reference(mu, rates.legitimate)
    if lost is None or rates.legitimate[1] == 0.0 or lost.growth < 1.0:
        return []
    return [
        f"the legitimate estimator's expected error grows without bound unless {lost.remedy}: acknowledgements of packets that "
        f"it missed are forged, with link quality {mu:g} and spectral radius {scenario.process.process.spectral_radius:.6g}"
    ]


def _filter_warnings(scenario: Scenario) -> list[str]:
    """Warnings about a Q that does not match the sensor's filter, and about a singular Q, which reveals packet types.

    Source: docs/mathematics/plant.md, a filter at the sensor.
    """
    warnings = []
    process, driven = scenario.process.process, scenario.driven
    if driven is not None and driven.output_matrix is not None:
        wanted = settled(process, driven).innovation
        if np.abs(wanted - process.Q).max() > _NEAR * np.abs(wanted).max():
            small = process.n <= _SHOWN_STATES
            warnings.append(
                f"process.Q is {process.Q.tolist() if small else 'another'}, but the sensor's filter adds, per slot, noise "
                f"with the covariance {wanted.tolist() if small else 'of its innovations'}: "
                f'process.Q = "filter" uses that; inputs and disturbances are not in it'
            )
    if process.singular_noise and is_singular(process.Q):
        measures = driven is not None and driven.output_matrix is not None and len(driven.output_matrix) < process.n
        usual = ", as always with fewer measurements than states" if measures else ""
        warnings.append(
            f"process.Q is singular{usual}: apart from A, inputs and disturbances, consecutive states differ only "
            "within its range, so anybody who knows A and Q recognises, with certainty, two states in a row, and an "
            "innovation after a state"
        )
    return warnings


def _recording_warnings(scenario: Scenario) -> list[str]:
    """A warning for each link whose trials all replay the same part of a recording."""
    warnings = []
    for receiver in scenario.receivers:
        outcomes = len(scenario.schedule(receiver).settings["loss"].get("outcomes", ""))
        if replays_a_recording(scenario, receiver) and scenario.slots < outcomes:
            warnings.append(
                f"all trials have the same losses on the link of {receiver}, the first {scenario.slots:,} of {outcomes:,} "
                f"recorded outcomes, and results hold for these alone; random_start = true uses all of them"
            )
    return warnings


def written_bytes(scenario: Scenario) -> float:
    """The approximate size of the results folder in bytes, before compression."""
    n, receivers = len(scenario.process.A), len(scenario.receivers)
    recorded_row = 8 * (2 * n + n * n) + 40
    journal_row = scenario.trials / 8 + 60
    digest_rows = scenario.trials / 256 * 34
    return scenario.slots * receivers * (recorded_row * scenario.record_trials + journal_row + digest_rows + 80)
