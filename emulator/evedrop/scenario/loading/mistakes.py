"""The second of the two phases of a check: mistakes that only show when valid tables are compared.

Source: docs/architecture.md, how a scenario is checked.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import ValidationError

from evedrop.errors import UsageError
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
from evedrop.scenario.nemesis import nemesis_mistakes
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.receivers import EavesdropperTable
from evedrop.scenario.sentences import sentences
from evedrop.scenario.singular_noise import singular_mistakes
from evedrop.scenario.stream_keys import secret_in
from evedrop.scenario.tables import Scenario
from evedrop.scenario.valid import ValidTables

_ANY_PROCESS = Process(np.eye(1), np.eye(1), np.eye(1))  # the existence of a theory does not depend on the process


def mistakes_across(tables: ValidTables, beyond_horizon: bool) -> list[str]:
    """Mistakes across tables, as far as a faulty file can be checked."""
    mistakes: list[str] = []
    if tables.process is not None and tables.slots is not None and not beyond_horizon:
        mistakes += horizon_mistakes(tables.process.process, tables.slots)
    trials = tables.trials
    if trials is not None and tables.record_trials is not None and tables.record_trials > trials:
        mistakes.append(f"record_trials: is {tables.record_trials}; expected at most trials, which is {trials}")
    if trials is not None and tables.shards is not None and tables.shards > trials:
        most = f"expected at most trials, which is {trials}: a shard has one trial or more"
        mistakes.append(f"shards: is {tables.shards}; {most}")
    for phase in (
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
        mistakes += phase(tables)
    if tables.scenario is not None and not mistakes:
        mistakes += _application_objections(tables.scenario)
    if tables.nemesis is not None and tables.all_receivers:
        mistakes += nemesis_mistakes(tables.nemesis, tables.slots, tables.receivers)
    if tables.scenario is not None and not mistakes:
        try:
            _ = tables.scenario.timeline
        except ValidationError as error:
            together = "event: several of them together result in an invalid link"
            mistakes += [f"{together}: {line}" for line in sentences(error, LinkTable)]
    if tables.secret_file is not None:
        try:
            secret_in(tables.secret_file)
        except UsageError as error:
            mistakes.append(str(error))
    return [*mistakes, *_expectation_mistakes(tables, sound=not mistakes)]


def _expectation_mistakes(tables: ValidTables, sound: bool) -> Iterator[str]:
    """sound: whether there are no other mistakes across tables."""
    around = Around(
        tables.receivers,
        tables.slots,
        tables.trials,
        lambda name: _assumed(tables.process) or _no_theory(name, tables, sound),
        tables.applications,
        None if tables.process is None else list(tables.process.directions or {}),
    )
    for i, expectation in tables.expect if tables.all_receivers else ():
        yield from (f"expect.{i}.{entry}: {sentence}" for entry, sentence in around.mistakes(expectation))


def _assumed(process: ProcessTable | None) -> str | None:
    """The reason why theory expects nothing of given states; None if it may."""
    if process is None or not process.given or process.theory:
        return None
    return f"A and Q need not describe states that come from a {process.source}; theory = true says that they do"


def _no_theory(name: str, tables: ValidTables, sound: bool) -> str | None:
    """The reason why no theory covers a receiver; None if a theory does, or if its table or the scheme's has mistakes.

    sound: whether there are no other mistakes: a valid scenario's events are then considered too.
    """
    receiver = tables.legitimate if name == LEGITIMATE else tables.eavesdroppers.get(name)
    if tables.encoding is None or receiver is None:
        return None
    scheme = scheme_of(_ANY_PROCESS, tables.encoding.spec)
    if isinstance(receiver, EavesdropperTable):
        link = receiver.pool
        closed = receiver.strategy in scheme.closed_forms
        if not closed and eavesdropper_outcomes(scheme, receiver.strategy, receiver.parameters) is None:
            return f"no closed form is known for the strategy {receiver.strategy} of {name}"
    else:
        link = receiver.link
        if LEGITIMATE not in scheme.closed_forms and legitimate_outcomes(scheme) is None:
            return f"no closed form is known for the scheme {tables.encoding.scheme}"
    if distribution_of(LinkSchedule(link.settings(1.0), receiver.window)) is None:
        return f"no theory covers {name}'s link"
    if tables.scenario is None or not sound:
        return None
    has_theory = expectations_of(tables.scenario)[name].known
    return None if has_theory else f"no theory covers {name} with these links, attacks and events together"


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
