"""The second of the two phases of a check: mistakes that only show when typed tables are compared.

They are in events (names, slots, changes of links, and their order), links, acknowledgements, strategies, applications, and
expectations. `mistakes_across` lists them all, with those of the closed loop and of the process noise.

Source: docs/architecture.md, how a scenario is checked; docs/scenario.md, events, links and acknowledgements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from evedrop.counting import counted
from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.links.loss_model import Fate
from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes
from evedrop.model.process import Process
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.streams import LAST_TRIAL
from evedrop.model.theory.horizon import horizon
from evedrop.names import LEGITIMATE
from evedrop.scenario.application import APPLICATIONS, Application, Kind
from evedrop.scenario.closed_loop import controlled_plant, given_state_mistakes, loop_mistakes
from evedrop.scenario.events.event import Act, EventKind, Surroundings
from evedrop.scenario.expect import Around
from evedrop.scenario.plant import PlantTable
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.process_noise import filter_mistakes, singular_mistakes
from evedrop.scenario.receivers import (
    CHANGEABLE,
    LinkTable,
    changed_link,
    entries_after,
    other_model,
    tie_of,
    unchangeable,
)
from evedrop.scenario.table import Table, sentences
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.scenario.timeline import numbered_acts
from evedrop.scenario.words import as_toml, listed

Numbered = tuple[int, Act]
"""An act with the number of its event."""


def event_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes across tables in events that are valid by themselves, each with the number of its event."""
    surroundings = Surroundings(
        scenario.scheme,
        scenario.encoding.scheme,
        "none" if scenario.acknowledgements is None else scenario.acknowledgements.attack,
        any(APPLICATIONS[name].has_monitor for name in scenario.applications),
    )
    for i, event in enumerate(scenario.event):
        path = f"event.{i}"
        yield from _when_mistakes(path, event, scenario.slots)
        yield from _name_mistakes(path, event, scenario.receivers)
        yield from _own(path, type(event), partial(_compared, path, event, surroundings))
    yield from _changes_mistakes(scenario)
    acts = numbered_acts(scenario.event)
    for name in scenario.receivers:
        yield from _order_mistakes(name, [(i, act) for i, act in acts if name in act.names])
    kinds = dict.fromkeys(type(event) for event in scenario.event)
    for kind in kinds:
        events = [(i, event) for i, event in enumerate(scenario.event) if type(event) is kind]
        yield from _own(f"event.{events[0][0]}", kind, partial(kind.in_turn, events))


def _name_mistakes(path: str, event: EventKind, receivers: Sequence[str]) -> Iterator[str]:
    """Names in an event, and in the acts of an event of a package, that are not receivers."""
    entries = dict.fromkeys((name, str(event.names_in)) for name in event.names)
    entries |= dict.fromkeys((name, act.entry) for act in event.acts() for name in act.names if name not in event.names)
    for name, entry in entries:
        if name not in receivers:
            hint = ": it is not a receiver" if name in ("sensor", "router", "recorder") else ""
            yield f"{path}.{entry}: names {as_toml(name)}{hint}; expected {listed(receivers)}"


def _compared(path: str, event: EventKind, surroundings: Surroundings) -> Iterator[str]:
    return (f"{path}.{entry}: {sentence}" for entry, sentence in event.compared(surroundings))


def _own(path: str, kind: type[EventKind], ask: Callable[[], Iterator[str]]) -> list[str]:
    """The mistakes that a kind finds itself, or the error that it raised: its class may come from a package."""
    try:
        return list(ask())
    except CLASS_ERRORS as error:
        return [f"{path}.{kind.kind}: cannot be checked: {kind.__name__} raised {place_of(error)}"]


def away_in(scenario: Scenario, name: str, slot: int) -> str | None:
    """Say that a receiver is down or paused in a slot, and by which event; None if it is present."""
    away = None
    for i, act in numbered_acts(scenario.event):
        if act.at <= slot and name in act.names and act.effect.present is not None:
            away = None if act.effect.present else (i, act.at, act.effect.reason)
    return None if away is None else f"{name} is {_said(away[2])} (event.{away[0]}, from slot {away[1]} on)"


def _said(reason: Fate) -> str:
    return reason.name.lower()


def _when_mistakes(path: str, event: EventKind, slots: int) -> Iterator[str]:
    if event.first >= slots:
        entry = "at" if event.at is not None else "from"
        yield f"{path}.{entry}: is {event.first}, but the last slot is {slots - 1}; expected a slot of the run"
    if event.to is not None and event.to > slots:
        yield f"{path}.to: is {event.to}; expected at most {slots}, the end of the run"
    elif (late := max(act.at for act in event.acts())) > max(slots, event.first):
        yield f"{path}.{event.kind}: has an act at slot {late}; expected at most {slots}, the end of the run"


def _changes_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes in the changes of links, each made on top of the earlier ones that are right."""
    changed: dict[str, Mapping[str, Any]] = {}
    for i, act in numbered_acts(scenario.event):
        entries = act.effect.entries
        for name in act.names if act.effect.changes_settings else ():
            before = changed.get(name, {})
            mistakes = (
                [] if entries is None else [*change_mistakes(f"event.{i}.{act.entry}", name, entries, scenario, before)]
            )
            yield from mistakes
            if not mistakes:
                changed[name] = entries_after(before, entries)


def change_mistakes(
    path: str,
    name: str,
    changes: Mapping[str, Any],
    scenario: Scenario,
    before: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[str]:
    """Mistakes in the changed entries of a receiver's link. One link with a new quality or loss model replaces pooled links.

    before: the entries that are changed already.
    """
    entries = entries_after(before, {entry: value for entry, value in changes.items() if entry in CHANGEABLE})
    link = scenario.links.get(name)
    if link is None:
        if name not in scenario.eavesdroppers or scenario.eavesdroppers[name].links is None:
            return
        if not {"quality", "loss"} & set(entries):
            yield f"{path}: {name} has several links; expected a quality or a loss, for the one link that replaces them"
            return
        link = LinkTable(quality=1.0)
    yield from (f"{path}.{line}" for line in unchangeable(changes))
    try:
        changed = changed_link(link, entries)
    except ValidationError as error:
        yield from (f"{path}.{line}" for line in sentences(error, LinkTable))
        return
    if "delay" in changes:
        yield from (f"{path}.{line}" for line in changed.delay_mistakes(scenario.slot_seconds))
    if changes.get("rate") is not None and scenario.scheme.may_be_silent:
        yield f"{path}.rate: {_silent(scenario)}"
    ties = {receiver: link.correlation.to for receiver, link in scenario.links.items() if link.correlation is not None}
    tie = tie_of(name, ties)
    if tie is not None and changed.loss_spec["model"] != link.loss_spec["model"]:
        yield f"{path}.{other_model(name, changes, tie)}"


def _silent(scenario: Scenario) -> str:
    """The mistake of a link of limited rate with a scheme that may be silent."""
    return (
        f"is given, but the scheme {scenario.encoding.scheme} may stay silent, and a queue counts on a packet in every slot; "
        "remove the line"
    )


def _order_mistakes(name: str, acts: Sequence[Numbered]) -> Iterator[str]:
    """Events of one receiver that end a cut or an outage that has not begun, or begin one while another of its kind lasts.

    acts: those that concern it, in order of slots.
    """
    cut: int | None = None
    away: tuple[int, Fate] | None = None
    ended = -1
    for i, act in acts:
        path = f"event.{i}.{act.entry}: {name}"
        effect = act.effect
        if effect.cuts is True:
            if cut is not None:
                yield f"{path} is cut already, from slot {cut} on; expected a heal before"
            cut = act.at
        if effect.cuts is False:
            if cut is None:
                yield f"{path} is not cut at slot {act.at}; expected a cut before"
            cut = None
        if effect.present is False:
            if away is not None:
                yield f"{path} is {_said(away[1])} already, from slot {away[0]} on; expected it to be back"
            elif act.at == ended:
                yield f"{path} comes back only in slot {act.at}; expected a later slot"
            away = act.at, effect.reason
        if effect.present is True:
            if away is None or away[1] != effect.reason:
                yield f"{path} is not {_said(effect.reason)} at slot {act.at}; expected a {effect.after} before"
            elif act.at <= away[0]:
                yield f"{path} leaves in the same slot, {act.at}; expected a later slot"
            away, ended = None, act.at


def link_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes in correlations, and in delays in seconds."""
    for name, link in scenario.links.items():
        path = scenario.link_path(name)
        yield from (f"{path}.{line}" for line in link.delay_mistakes(scenario.slot_seconds))
        if link.correlation is not None:
            yield from _correlation_mistakes(f"{path}.correlation.with", name, link, link.correlation.to, scenario)
    for name in () if scenario.wire is None else scenario.wire.links:
        if name not in scenario.receivers:
            yield f"wire.links.{name}: is not a receiver; expected {listed(scenario.receivers)}"
        elif name not in scenario.links:
            yield f"wire.links.{name}: is a receiver with several links; expected one with a single link"


def _correlation_mistakes(entry: str, name: str, link: LinkTable, other: str, scenario: Scenario) -> Iterator[str]:
    links = scenario.links
    if other not in scenario.receivers or other == name:
        others = [receiver for receiver in scenario.receivers if receiver != name]
        yield f"{entry}: is {as_toml(other)}; expected another receiver" + (f": {listed(others)}" if others else "")
    elif other not in links:
        yield f"{entry}: is {other}, which has several links; expected a receiver with a single link"
    elif links[other].correlation is not None:
        yield f"{entry}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
    elif links[other].loss_spec["model"] != link.loss_spec["model"]:
        models = f"{links[other].loss_spec['model']} there and {link.loss_spec['model']} here"
        yield f"{entry}: is {other}, but the loss models differ ({models}); expected the same model on both links"


def encoding_mistakes(scenario: Scenario) -> Iterator[str]:
    """A list of μ_d(k) that does not have one number for each slot."""
    given = scenario.encoding.state_probabilities
    if given is not None and len(given) != scenario.slots:
        yield (
            f"encoding.state_probability: has {counted(len(given), 'number')}; expected one number for each of the "
            f"{scenario.slots} slots, or a single number for all"
        )


def acknowledgement_mistakes(scenario: Scenario) -> Iterator[str]:
    """Missing or needless acknowledgements, an unknown jammer, and link rates with a scheme that may be silent."""
    encoding, scheme, acknowledgements = scenario.encoding, scenario.scheme, scenario.acknowledgements
    if scheme.needs_acknowledgements and acknowledgements is None:
        yield (
            f"acknowledgements: is missing; the scheme {encoding.scheme} acts on acknowledgements; expected a table "
            "[acknowledgements] with link = { quality = 0.9 }"
        )
    if not scheme.needs_acknowledgements and acknowledgements is not None:
        yield f"acknowledgements: is given, but the scheme {encoding.scheme} needs none; remove the table"
    jammer = None if acknowledgements is None else acknowledgements.jammer
    eavesdroppers = scenario.receivers[1:]
    if jammer is not None and jammer not in eavesdroppers:
        yield f"acknowledgements.jammer: is {as_toml(jammer)}; expected an eavesdropper" + (
            f": {listed(eavesdroppers)}" if eavesdroppers else ", such as smart, in a table of its own"
        )
    if scheme.may_be_silent:
        for receiver, link in scenario.links.items():
            if link.rate is not None:
                yield f"{scenario.link_path(receiver)}.rate: {_silent(scenario)}"


def scheme_mistakes(scenario: Scenario) -> Iterator[str]:
    """Parameters of the scheme that do not fit the process."""
    for entry, sentence in scenario.scheme.mistakes_with(scenario.process.process, scenario.encoding.parameters):
        yield f"encoding.{entry}: {sentence}"


def strategy_mistakes(scenario: Scenario) -> Iterator[str]:
    """Strategies that need a stream the scheme lacks, and leaks in a slot beyond the run or while the eavesdropper is away."""
    for name, table in scenario.eavesdroppers.items():
        strategy, path = STRATEGIES[table.strategy], f"eavesdroppers.{name}"
        lacking = lacking_streams(strategy.streams(table.parameters), scenario.scheme)
        if lacking:
            entry, value = ("reads_as", table.reads_as) if table.reads_as else ("strategy", table.strategy)
            able = [reader for reader in READERS if not READERS[reader].streams({})]
            yield (
                f"{path}.{entry}: is {as_toml(value)}, which is defined by its knowledge of the {listed(lacking)}, and the "
                f"scheme {scenario.encoding.scheme} has none; expected {listed(sorted(able))}"
            )
        betrayed = strategy.betrayed(table.parameters)
        if betrayed is None:
            continue
        if betrayed >= scenario.slots:
            yield f"{path}.learns_at: is {betrayed}; expected a slot of the run, 0 to {scenario.slots - 1}"
        away = away_in(scenario, name, betrayed)
        if away is not None:
            yield f"{path}.learns_at: is {betrayed}, when {away}; expected a slot in which it is present"


def lacking_streams(streams: Iterable[str], scheme: type[Scheme]) -> list[str]:
    """The streams whose keys a strategy needs and a scheme does not have; the strategy's own coin is not among them."""
    return [stream for stream in streams if stream != "coin" and stream not in scheme.secret_streams]


def application_mistakes(scenario: Scenario) -> Iterator[str]:
    """Applications without plant or controller, wrong names and units, and eavesdroppers of the same name."""
    for name, table in scenario.applications.items():
        if scenario.plant is None or scenario.controller is None:
            yield f"{name}: is given without a [plant] and a [controller]; expected both, or no table [{name}]"
        else:
            yield from _named_mistakes(
                name, APPLICATIONS[name], table, _quantities_of(scenario.process, scenario.plant)
            )
            if APPLICATIONS[name].powers and scenario.slot_seconds is None:
                yield (
                    f"slot_seconds: is missing, and the energies of [{name}] need the duration of a slot; expected it, such as "
                    "slot_seconds = 60.0"
                )
        if name in scenario.receivers[1:]:
            yield f"eavesdroppers.{name}: is a name that the {name}'s metrics use; expected another"


class _Quantities(NamedTuple):
    """The states, inputs or disturbances of a scenario."""

    entry: str
    """Where the scenario names them."""
    names: list[str]
    units: list[str]
    """As many as names, or none."""


def _quantities_of(process: ProcessTable, plant: PlantTable) -> dict[Kind, _Quantities]:
    return {
        "states": _Quantities("process.states", process.states or [], process.units or []),
        "inputs": _Quantities("plant.inputs", plant.inputs, plant.input_units or []),
        "disturbances": _Quantities("plant.disturbances", plant.disturbances, plant.disturbance_units or []),
    }


def _named_mistakes(
    name: str, application: type[Application], table: Table, quantities: Mapping[Kind, _Quantities]
) -> Iterator[str]:
    """Names of an application's table that the scenario does not have, and powers that it has in another unit."""
    for entry, kind in application.names.items():
        given, (where, names, units) = getattr(table, entry), quantities[kind]
        if given is not None and given not in names:
            choice = f"expected one of {listed(names)}" if names else f"expected {where} = [{as_toml(given)}, …]"
            yield f"{name}.{entry}: is {as_toml(given)}, which is not among {where}; {choice}"
        unit = dict(zip(names, units, strict=False)).get(given, _POWER)
        if entry in application.powers and unit != _POWER:
            yield f"{name}.{entry}: is {as_toml(given)}, which is in {unit}; expected a power in {_POWER}"


_POWER = "kW"
_ANY_PROCESS = Process(np.eye(1), np.eye(1), np.eye(1))  # the existence of a theory does not depend on the process


def mistakes_across(scenario: Scenario, beyond_horizon: bool) -> list[str]:
    """Mistakes that only show when the tables of a scenario are compared."""
    mistakes: list[str] = []
    slots, trials = scenario.slots, scenario.trials
    if not beyond_horizon:
        mistakes += horizon_mistakes(scenario.process.process, slots)
    if scenario.record_trials > trials:
        mistakes.append(f"record_trials: is {scenario.record_trials}; expected at most trials, which is {trials}")
    if (last := scenario.first_trial + trials - 1) > LAST_TRIAL:
        mistakes.append(
            f"first_trial: is {scenario.first_trial}, and the last trial {last}; expected at most {LAST_TRIAL}"
        )
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
    if loop is None:
        return []
    asked = ((APPLICATIONS[name], table) for name, table in scenario.applications.items())
    return [objection for application, table in asked for objection in application.objections(loop, table)]


def horizon_mistakes(process: Process, slots: int) -> list[str]:
    """A mistake if float64 cannot follow the process for that many slots (docs/mathematics/numerics.md, horizon)."""
    if not process.Q.any():
        return [
            "process.Q: is 0, and a process without noise is not supported; expected noise in at least one direction"
        ]
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
