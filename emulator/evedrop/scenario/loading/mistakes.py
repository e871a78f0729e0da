"""The second of the two phases of a check: the tables, each valid by itself, are compared.

Source: docs/architecture.md, how a scenario is checked.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import ValidationError

from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes
from evedrop.model.process import Process
from evedrop.model.schemes import scheme_of
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.theory.horizon import horizon
from evedrop.names import LEGITIMATE
from evedrop.scenario.across import (
    acknowledgement_mistakes,
    application_mistakes,
    encoding_mistakes,
    link_mistakes,
    scheme_mistakes,
    strategy_mistakes,
)
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.closed_loop import given_state_mistakes, loop_mistakes
from evedrop.scenario.controlled import controlled_plant
from evedrop.scenario.event_mistakes import event_mistakes
from evedrop.scenario.expect import Around
from evedrop.scenario.expected.expectations import expectations_of
from evedrop.scenario.filter_noise import filter_mistakes
from evedrop.scenario.link_table import LinkTable
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.sentences import sentences
from evedrop.scenario.singular_noise import singular_mistakes
from evedrop.scenario.tables import Scenario

_ANY_PROCESS = Process(np.eye(1), np.eye(1), np.eye(1))  # the existence of a theory does not depend on the process


def mistakes_across(scenario: Scenario, beyond_horizon: bool) -> list[str]:
    """Mistakes that only show when the tables of a scenario are compared."""
    mistakes: list[str] = []
    slots, trials = scenario.slots, scenario.trials
    if not beyond_horizon:
        mistakes += horizon_mistakes(scenario.process.process, slots)
    if scenario.record_trials > trials:
        mistakes.append(f"record_trials: is {scenario.record_trials}; expected at most trials, which is {trials}")
    if scenario.shards > trials:
        most = f"expected at most trials, which is {trials}: a shard has one trial or more"
        mistakes.append(f"shards: is {scenario.shards}; {most}")
    for compare in (
        scheme_mistakes,
        strategy_mistakes,
        encoding_mistakes,
        acknowledgement_mistakes,
        loop_mistakes,
        given_state_mistakes,
        application_mistakes,
        filter_mistakes,
        singular_mistakes,
        link_mistakes,
        event_mistakes,
    ):
        mistakes += compare(scenario)
    if not mistakes:
        mistakes += _application_objections(scenario)
    if not mistakes:
        try:
            _ = scenario.timeline
        except ValidationError as error:
            together = "event: several of them together result in an invalid link"
            mistakes += [f"{together}: {line}" for line in sentences(error, LinkTable)]
    return [*mistakes, *_expectation_mistakes(scenario, sound=not mistakes)]


def _expectation_mistakes(scenario: Scenario, sound: bool) -> Iterator[str]:
    """sound: whether there are no other mistakes across tables."""
    around = Around(
        scenario.receivers,
        scenario.slots,
        scenario.trials,
        lambda name: _assumed(scenario.process) or _no_theory(name, scenario, sound),
        {name: APPLICATIONS[name] for name in scenario.applications},
        list(scenario.process.directions or {}),
    )
    for i, expectation in enumerate(scenario.expect):
        yield from (f"expect.{i}.{entry}: {sentence}" for entry, sentence in around.mistakes(expectation))


def _assumed(process: ProcessTable) -> str | None:
    """The reason why theory expects nothing of given states; None if it may."""
    if not process.given or process.theory:
        return None
    return f"A and Q need not describe states that come from a {process.source}; theory = true says that they do"


def _no_theory(name: str, scenario: Scenario, sound: bool) -> str | None:
    """The reason why no theory covers a receiver; None if a theory does.

    sound: whether there are no other mistakes: the events are then considered too.
    """
    scheme = scheme_of(_ANY_PROCESS, scenario.encoding.spec)
    if name in scenario.eavesdroppers:
        receiver = scenario.eavesdroppers[name]
        closed = receiver.strategy in scheme.closed_forms
        if not closed and eavesdropper_outcomes(scheme, receiver.strategy, receiver.parameters) is None:
            return f"no closed form is known for the strategy {receiver.strategy} of {name}"
    elif LEGITIMATE not in scheme.closed_forms and legitimate_outcomes(scheme) is None:
        return f"no closed form is known for the scheme {scenario.encoding.scheme}"
    if distribution_of(LinkSchedule(scenario.link(name).settings(1.0), scenario.window(name))) is None:
        return f"no theory covers {name}'s link"
    covered = not sound or expectations_of(scenario)[name].known
    return None if covered else f"no theory covers {name} with these links, attacks and events together"


def _application_objections(scenario: Scenario) -> list[str]:
    """Mistakes that applications find in a scenario that is otherwise valid."""
    loop = controlled_plant(scenario)
    objecting = [(name, APPLICATIONS[name], table) for name, table in scenario.applications.items() if loop is not None]
    return [
        objection
        for _, application, table in objecting
        if loop is not None
        for objection in application.objections(loop, table)
    ]


def horizon_mistakes(process: Process, slots: int) -> list[str]:
    """A mistake if float64 cannot follow the process for that many slots (docs/mathematics.md, horizon)."""
    last = horizon(process, slots)
    if last is None:
        return []
    rounded = "float64 rounds off more than 1 % of the process noise inside a state this large"
    change = "a smaller initial_covariance or a larger Q"
    if last < 0:
        return [
            f"process: cannot be followed in any slot, because {rounded} as the initial one. Ways out: {change}; "
            "initial variances up to 8e27 times those of Q can be followed"
        ]
    return [
        f"slots: is {slots}; this process (spectral radius {process.spectral_radius:.4g}) can be followed up to slot "
        f"{last}: beyond it {rounded}. Ways out: slots = {last + 1}{' or fewer' if last else ''}; {change}; an A with a "
        "smaller spectral radius"
    ]
