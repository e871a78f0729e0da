"""A dry run of classes that are not built in: a few slots of the scenario in memory, before any process is started.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from evedrop.errors import NoAnswer
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import REMOTE_CALLS, STRATEGIES
from evedrop.model.integrity import SENSOR_ATTACKS
from evedrop.model.links import LOSS_MODELS, POOLED, single_specs
from evedrop.model.registry import Registry
from evedrop.model.schemes import SCHEMES
from evedrop.model.streams import Batch
from evedrop.scenario.conformance.eavesdroppers import EavesdropperChecks
from evedrop.scenario.conformance.links import DelayChecks, LossChecks
from evedrop.scenario.conformance.problems import Problem
from evedrop.scenario.conformance.rules import how_broken
from evedrop.scenario.conformance.schemes import SchemeChecks
from evedrop.scenario.plugins import names_in
from evedrop.scenario.receivers import EavesdropperTable, LinkTable, changed_link
from evedrop.scenario.tables import NUMBERS, Scenario
from evedrop.scenario.words import as_toml

_SLOTS = 4
_TRIALS = 3


def foreign(tables: Any) -> bool:
    """Whether tables name any class that is not built in."""
    built_in = {POOLED}.union(SCHEMES, STRATEGIES, LOSS_MODELS, DELAY_MODELS, CONTROLLERS, SENSOR_ATTACKS)
    return any(name not in built_in for name in names_in(tables))


def has_foreign(scenario: Scenario) -> bool:
    """Whether a scenario names any class that is not built in."""
    return foreign(scenario.model_dump(exclude_unset=True, exclude=NUMBERS))


def dry_run(scenario: Scenario) -> list[str]:
    """Try the classes that are not built in; returns a mistake for each that breaks a rule on shapes, types or keys, or raises.

    Does not affect the digests of the run.
    """
    if not has_foreign(scenario):
        return []
    batch = Batch(min(scenario.slots, _SLOTS), _TRIALS, scenario.first_trial)
    problem = Problem(scenario.process.process, batch)
    mistakes = [*_link_mistakes(scenario, problem)]
    kind = scenario.scheme
    if SCHEMES.foreign(scenario.encoding.scheme):
        broken = how_broken(SchemeChecks(kind, scenario.encoding.parameters).at_first, problem)
        if broken is not None:
            return [*mistakes, f"encoding.scheme: is {as_toml(scenario.encoding.scheme)}; in a dry run: {broken}"]
    for name, table in scenario.eavesdroppers.items():
        entry = "strategy" if table.reads_as is None else "reads_as"
        if not SCHEMES.foreign(scenario.encoding.scheme) and not STRATEGIES.foreign(getattr(table, entry)):
            continue
        broken = _eavesdropper_broken(scenario, table, entry, batch)
        if broken is not None:
            mistakes.append(
                f"eavesdroppers.{name}.{entry}: is {as_toml(getattr(table, entry))}; in a dry run: {broken}"
            )
    return mistakes


def _eavesdropper_broken(scenario: Scenario, table: EavesdropperTable, entry: str, batch: Batch) -> str | None:
    """What breaks when an eavesdropper hears the scheme; a class that is not built in runs in a process of its own."""
    spec, name = scenario.encoding.spec, getattr(table, entry)
    if not STRATEGIES.foreign(name):
        kind = scenario.scheme
        strategy = STRATEGIES[table.strategy]
        checks = EavesdropperChecks(table.strategy, strategy, table.parameters, kind, scenario.encoding.parameters)
        return how_broken(checks.at_first, Problem(scenario.process.process, batch))
    public = scenario.process
    process = (public.A, public.Q, public.initial_covariance, public.singular_noise)
    registry = "STRATEGIES" if entry == "strategy" else "READERS"
    try:
        drawn = (batch.slots, batch.trials, batch.first_trial)
        answer = REMOTE_CALLS.call(name, "dry_run", registry, table.strategy, table.parameters, spec, process, drawn)
        if answer is None:
            _ask_for_theory(scenario, table)
    except NoAnswer as error:
        return str(error)
    return None if answer is None else str(answer)


def _ask_for_theory(scenario: Scenario, table: EavesdropperTable) -> None:
    """Raise NoAnswer if a class's answer about its outcomes is invalid."""
    outcomes_at = STRATEGIES[table.strategy].outcomes(table.parameters, scenario.encoding.mu_d)
    if outcomes_at is not None:
        for quality in (0.0, 0.5, 1.0):
            outcomes_at(quality)


def _link_mistakes(scenario: Scenario, problem: Problem) -> Iterator[str]:
    for receiver in scenario.receivers:
        settings, window = scenario.link(receiver).settings(scenario.slot_seconds), scenario.window(receiver)
        yield from _settings_mistakes(scenario.link_path(receiver), settings, problem, scenario.slots, window)
    for i, event in enumerate(scenario.event):
        # An event's models are checked when tables are compared: mistakes are reported there, not here.
        for act in event.acts():
            entries = act.effect.entries
            if entries is not None and _describes_models(entries):
                window = max(map(scenario.window, {*act.names} & {*scenario.receivers}), default=0)
                yield from _settings_mistakes(f"event.{i}.{act.entry}", entries, problem, scenario.slots, window)


def _describes_models(settings: Mapping[str, Any]) -> bool:
    """Whether the loss and delay models that an event changes can be constructed from their descriptions."""
    described = {name: settings[name] for name in ("loss", "delay") if name in settings}
    try:
        changed_link(LinkTable(quality=1.0), described)
    except ValidationError:
        return False
    return True


def _settings_mistakes(
    path: str, settings: Mapping[str, Any], problem: Problem, slots: int, window: int
) -> Iterator[str]:
    """slots, window: of the scenario, for which theory asks the models."""
    losses, delay = settings.get("loss"), settings.get("delay")
    for spec in single_specs(losses) if losses else ():
        yield from _model_mistakes(f"{path}.loss", LOSS_MODELS, LossChecks, spec, problem, range(slots))
    if delay:
        in_slots = {name: value for name, value in delay.items() if name != "unit"}
        yield from _model_mistakes(f"{path}.delay", DELAY_MODELS, DelayChecks, in_slots, problem, window + 1)


def _model_mistakes(
    path: str,
    models: Registry[Any],
    checks: type[LossChecks] | type[DelayChecks],
    spec: Mapping[str, Any],
    problem: Problem,
    stated: Any,
) -> Iterator[str]:
    """stated: the slots, or the number of lags, for which the model must give probabilities."""
    if models.foreign(spec["model"]):
        parameters = {name: value for name, value in spec.items() if name != "model"}
        made = checks(models[spec["model"]], parameters)
        broken = how_broken(made.shapes, problem) or how_broken(made.stated, stated)
        if broken is not None:
            yield f"{path}.model: is {as_toml(spec['model'])}; in a dry run: {broken}"
