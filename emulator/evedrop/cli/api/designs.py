"""The functions that design a scheme: μ_d, a μ_d for each slot, when to send, and when to encrypt.

Source: docs/design.md.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.cli.api.running import scenario_of
from evedrop.cli.words import for_programs, speaks_python
from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.schemes import SCHEMES
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.names import LEGITIMATE
from evedrop.scenario.arguments import number_argument, refuse_unless
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import dotted, listed, options_of

if TYPE_CHECKING:
    from evedrop.model.theory.design import Design
    from evedrop.model.theory.ratio import Adversary
    from evedrop.model.theory.schedules import ScheduleDesign
    from evedrop.scenario.designs import BudgetDesign, PolicyDesign


def measuring_command(given: str | Path | Scenario, changes: Mapping[str, Any], made: Scenario) -> str:
    """A command, or for programs a call, that simulates the scenario: over a grid of μ_d if it has one μ_d, otherwise as it is.

    given: the scenario as the caller named it; a Scenario, which has no name, is called SCENARIO; changes: those of the call;
    made: the scenario with these changes.
    """
    mu_d = made.encoding.parameters.get("state_probability")
    constant = isinstance(mu_d, (int, float))
    if for_programs():
        grid = [f"{{'encoding.state_probability': {[i / 10 for i in range(1, 10)]}}}"] if constant else []
        words = ["SCENARIO" if isinstance(given, Scenario) else repr(str(given)), *grid]
        given_changes = dotted(changes)
        keywords = {key.replace(".", "__"): value for key, value in given_changes.items()}
        if all(word.isidentifier() for word in keywords) and dotted(keywords) == given_changes:
            words += [f"{word}={value!r}" for word, value in keywords.items()]
        else:  # a keyword cannot contain a name such as much-better
            words.append(f"**{given_changes!r}")
        return f"{'sweep' if constant else 'montecarlo'}({', '.join(words)})"
    words = [
        "evedrop",
        "sweep" if constant else "montecarlo",
        "SCENARIO" if isinstance(given, Scenario) else str(given),
    ]
    words += options_of(changes)
    if constant:
        words += ["--over", "encoding.state_probability=0.1:0.9:0.1"]
    return shlex.join(words)


_LONGEST_SCHEDULE = 100  # designed in a minute
_TWENTIETHS = tuple(float(i) / 20 for i in range(21))


@speaks_python
def design(
    scenario: str | Path | Scenario,
    *,
    max_trace: float | None = None,
    min_ratio: float | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Design:
    """The admissible μ_d for a scenario's process and links, and the cost and secrecy of each choice.

    max_trace: Ω, for which the least μ_d that keeps the limiting trace below it is computed, too; min_ratio: how many times
    larger than the legitimate error every eavesdropper's is to be, for which the cheapest μ_d is chosen, one that keeps Ω if both
    are given; changes: entries by dotted key.

    Raises ScenarioError with every mistake of the scenario, UsageError if the scheme does not send states and innovations, if
    the losses of a link are not independent and alike in all slots, or if Ω is infinite, or no μ_d keeps the trace below it or
    has the ratio. The error names a command that measures what cannot be designed.
    """
    from evedrop.cli.api.shown_designs import ShownDesign, shown_as  # a run does not need it
    from evedrop.model.theory.design import design as design_of  # the same

    made, measured = _designable(scenario, changes or {})
    _refuse_texts(max_trace=max_trace, min_ratio=min_ratio)
    if max_trace == math.inf:
        raise UsageError("an infinite largest trace is kept by every admissible μ_d; give a finite one")
    if min_ratio is not None and not 0.0 < min_ratio < math.inf:
        raise UsageError(f"a least ratio of {min_ratio:g}: expected a finite number above 0, such as 10")
    if made.encoding.state_probabilities is not None:
        raise UsageError(
            "the design of μ_d is for one μ_d in all slots, whose limits it compares, and encoding.state_probability is a list; "
            "change it, as by encoding.state_probability=0.6, or design a schedule, which is another list; "
            f"{measured} measures this one"
        )
    mu, adversaries, left_out = _adversaries(made, measured)
    if min_ratio is not None and not adversaries:
        raise UsageError(
            "a least ratio is for eavesdroppers whose error has a closed form, and the scenario has none; add one, such as "
            f'eavesdroppers.genie={{strategy = "genie", link = {{quality = 0.9}}}}, or measure those it has: {measured}'
        )
    designed = design_of(made.process.process, mu, made.encoding.mu_d, adversaries, made.slots, max_trace, min_ratio)
    return shown_as(ShownDesign, replace(designed, left_out=left_out, measuring=measured))


def _designable(given: str | Path | Scenario, changes: Mapping[str, Any]) -> tuple[Scenario, str]:
    """The scenario, and the command that measures what cannot be designed. Raises UsageError if its scheme cannot be designed."""
    made = scenario_of(given, changes, beyond_horizon=True)
    measured = measuring_command(given, changes, made)
    if not SCHEMES[made.encoding.scheme].sends_states_and_innovations:
        raise UsageError(_not_for(made.encoding.scheme, measured))
    return made, measured


def _adversaries(made: Scenario, measured: str) -> tuple[float, list[Adversary], dict[str, str]]:
    """μ, the eavesdroppers whose error has a closed form, and the strategies of the others. Raises UsageError for other links.

    measured: the command that measures what cannot be designed.
    """
    from evedrop.model.theory.covariances import limit_trace  # a run does not need these
    from evedrop.model.theory.ratio import Adversary

    quality = {}
    for name in made.receivers:
        distribution = distribution_of(made.schedule(name))
        alike = None if distribution is None else distribution.alike
        if alike is None:
            raise UsageError(
                "the design of μ_d is for independent losses that stay the same, without late packets and outages, and "
                f"the link of {name} is different; give it only a quality, such as "
                f"{'' if name == LEGITIMATE else 'eavesdroppers.'}{name}.link={{quality = 0.9}}, or measure the "
                f"scenario as it is: {measured}"
            )
        quality[name] = float(alike.quality[0])
    adversaries, left_out = [], {}
    for name, table in made.eavesdroppers.items():
        outcomes_at = STRATEGIES[table.strategy].outcomes(table.parameters, 0.5)
        adversary = outcomes_at and Adversary.with_outcomes(name, quality[name], outcomes_at(1.0))
        if adversary is None or math.isnan(limit_trace(made.process.process, adversary.outcomes(0.5))):
            left_out[name] = table.strategy
        else:
            adversaries.append(adversary)
    return quality[LEGITIMATE], adversaries, left_out


@speaks_python
def design_schedule(
    scenario: str | Path | Scenario,
    slots: int,
    *,
    max_trace: float | None = None,
    weight: float = 0.0,
    block: int = 1,
    changes: Mapping[str, Any] | None = None,
) -> ScheduleDesign:
    """A μ_d for each slot of a short run, against each eavesdropper of a scenario.

    slots: N, from 2 to 100; max_trace: Ω, below which the legitimate trace stays in every slot; weight: of the legitimate
    error in the sum, from 0 to 1; the eavesdropper's error has the rest; block: how many slots share a μ_d; changes: entries by
    dotted key.

    Raises ScenarioError with every mistake of the scenario, UsageError as `design` does, and for numbers out of range.
    """
    from evedrop.cli.api.shown_designs import ShownScheduleDesign  # a run does not need it
    from evedrop.model.theory.schedules import best_schedule  # the same

    made, measured = _designable(scenario, changes or {})
    _refuse_texts(max_trace=max_trace, weight=weight)
    _refuse_texts(whole=True, slots=slots, block=block)
    if not 2 <= slots <= _LONGEST_SCHEDULE:
        raise UsageError(
            f"a schedule of {counted(slots, 'slot')}: "
            f"expected a whole number from 2 to {_LONGEST_SCHEDULE}, the slots of the run"
        )
    if not 1 <= block < slots:
        raise UsageError(
            f"blocks of {counted(block, 'slot')}: expected a whole number from 1 to {slots - 1}, the slots that share a μ_d"
        )
    if not 0.0 <= weight <= 1.0:
        raise UsageError(f"a weight of {weight:g}: expected a number from 0 to 1, the weight of the legitimate error")
    if (max_trace is None or max_trace == math.inf) and weight == 0.0:
        raise UsageError(
            "a schedule needs a bound on the legitimate trace or a weight for it: give a largest trace, or a weight"
        )
    mu, adversaries, left_out = _adversaries(made, measured)
    bound, process = math.inf if max_trace is None else max_trace, made.process.process
    schedules = {
        adversary.name: best_schedule(process, mu, adversary.outcomes, slots, bound, weight, block)
        for adversary in adversaries
    }
    if not schedules:
        raise UsageError(
            "a schedule is designed against eavesdroppers whose error has a closed form, and the scenario has none; add one, "
            f'such as eavesdroppers.genie={{strategy = "genie", link = {{quality = 0.9}}}}, or measure those it has: {measured}'
        )
    return ShownScheduleDesign(schedules, left_out)


@speaks_python
def design_policy(
    scenario: str | Path | Scenario,
    *,
    weights: Sequence[float] = _TWENTIETHS,
    prices: Sequence[float] = (0.0,),
    states: int = 10,
    changes: Mapping[str, Any] | None = None,
) -> PolicyDesign:
    """When a sensor with acknowledgements should send: the Pareto front against each eavesdropper of a scenario.

    weights: of the legitimate error, from 0 to 1; the eavesdropper's has the rest; prices: of a transmission; states: how many
    holding times are distinguished; changes: entries by dotted key.

    Raises ScenarioError with every mistake of the scenario, UsageError if it is not one for policies, see
    `evedrop.scenario.designs.policies_of`.
    """
    from evedrop.cli.api.shown_designs import ShownPolicyDesign, shown_as  # a run does not need it
    from evedrop.scenario.designs import policies_of  # the same

    lists = {}
    for name, several in (("weights", weights), ("prices", prices)):
        refuse_unless(
            isinstance(several, Iterable) and not isinstance(several, str), name, several, "a list of numbers"
        )
        lists[name] = list(several)  # which may be read only once
        refuse_unless(bool(lists[name]), name, lists[name], "a list of numbers, at least one")
        for value in lists[name]:
            number_argument(name, value)
    number_argument("states", states, whole=True)
    made = scenario_of(scenario, changes or {}, beyond_horizon=True)
    return shown_as(ShownPolicyDesign, policies_of(made, lists["weights"], lists["prices"], states))


@speaks_python
def design_budget(
    scenario: str | Path | Scenario, budget: float, *, changes: Mapping[str, Any] | None = None
) -> BudgetDesign:
    """The threshold from which a sensor should encrypt, for an energy budget.

    budget: mean energy in a slot, in the unit of the scenario's `[energy]`; changes: entries by dotted key.

    Raises ScenarioError with every mistake of the scenario, UsageError if no threshold meets the budget, see
    `evedrop.scenario.designs.budget_of`.
    """
    from evedrop.cli.api.shown_designs import ShownBudgetDesign, shown_as  # a run does not need it
    from evedrop.scenario.designs import budget_of  # the same

    number_argument("budget", budget)
    return shown_as(ShownBudgetDesign, budget_of(scenario_of(scenario, changes or {}, beyond_horizon=True), budget))


def _refuse_texts(whole: bool = False, **numbers: object) -> None:
    """Raise UsageError for an argument that is not a number, or not a whole one if it must be; None is none."""
    for name, value in numbers.items():
        if value is not None:
            number_argument(name, value, whole)


def _not_for(scheme: str, measured: str) -> str:
    """The reason why a scheme cannot be designed, and two ways out; measured: the command that measures it."""
    designed = [name for name in SCHEMES if SCHEMES[name].sends_states_and_innovations]
    why = f"the design of μ_d is for the scheme {listed(designed)}"
    instead = 'give encoding={scheme = "innovation", state_probability = 0.6} to design that on this process'
    if SCHEMES.foreign(scheme):
        why = f"{why}; no closed form is known for {scheme}"
    elif SCHEMES[scheme].needs_acknowledgements:
        why = f"{why}, and this scenario has {scheme}"
        instead = (
            f"evedrop compare SCENARIO --schemes {scheme},innovation --out DIR measures both on this process, and writes "
            "DIR/scenarios/innovation.toml, which can be designed"
        )
    else:
        why = f"{why}, and this scenario has {scheme}"
    return f"{why}; {instead}, or measure {scheme}: {measured}"
