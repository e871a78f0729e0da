"""Runs drawn from a seed: a drawn scenario, and the faults that disturb it.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import astuple, dataclass

from evedrop.errors import UsageError
from evedrop.live.launch.briefs import MOST_SLOTS_AHEAD
from evedrop.scenario.loading import Scenario
from evedrop.virtual.broken_messages import BreakMessage
from evedrop.virtual.by_hand import RunByHand, WriteBriefs
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_faults import KINDS, faults_of
from evedrop.virtual.drawn_hosts import DrawnHosts, drawn_hosts, kind_with
from evedrop.virtual.drawn_scenarios import scenario_of
from evedrop.virtual.faults import ClogRouter, ShortenMessage
from evedrop.virtual.programs import DrawnProgram, drawn_program
from evedrop.virtual.rare_faults import RARE_KINDS, rare_faults

SEEDS_OF_A_SCENARIO = 6
"""How many seeds after each other play the same scenario: the same trials in memory are computed once for all of them."""
_AHEAD = (2, 3, 5, 8, 16, 40, MOST_SLOTS_AHEAD)
_LIMITED = 0.6
"""The fraction of the runs with enough slots in which the sensor has to wait for the others."""
_MOST_BLOCKS = 40
"""How often the sensor may have to wait, where it need not be ahead of others by little."""
_ALL_KINDS: Mapping[str, type[Disturbance]] = {**KINDS, **RARE_KINDS, ClogRouter.kind: ClogRouter}


@dataclass(frozen=True)
class SimulatedCase:
    """A run that is disturbed."""

    seed: int
    scenario: Scenario
    faults: tuple[Disturbance, ...]
    ahead: int = MOST_SLOTS_AHEAD
    """How many slots the sensor may be ahead: the flow control of a run of a hundred thousand slots fits into a few."""
    hosts: DrawnHosts | None = None
    """The other hosts, if there are any."""
    program: DrawnProgram | None = None
    """The program that publishes the states of the scenario; None: they are simulated, or in the scenario."""

    def __str__(self) -> str:
        scenario = self.scenario
        eves = ", ".join(table.strategy for table in scenario.eavesdroppers.values()) or "nobody"
        faults = "; ".join(map(str, self.faults)) or "no fault"
        return (
            f"{scenario.encoding.spec['scheme']} against {eves}, {scenario.slots} slots of {scenario.trials}, "
            f"{self.ahead} ahead{'' if self.hosts is None else f', {self.hosts}'}"
            f"{'' if self.program is None else f', {self.program}'}: {faults}"
        )

    def to_text(self) -> str:
        """The case in one line, from which `case_from` makes it again."""
        faults = [[fault.kind, *astuple(fault)] for fault in self.faults]
        tables = self.scenario.as_tables()
        hosts = {} if self.hosts is None else {"hosts": self.hosts.as_lists()}
        program = {} if self.program is None else {"program": self.program.as_list()}
        return json.dumps(
            {"seed": self.seed, "ahead": self.ahead, "faults": faults, **hosts, **program, "scenario": tables}
        )

    @property
    def live(self) -> Scenario:
        """The scenario as it is run live."""
        return self.scenario if self.program is None else self.program.scenario(self.scenario)


def case_from(text: str) -> SimulatedCase:
    """The case of a text: of a seed alone, or of a line that `SimulatedCase.to_text` has written. Raises UsageError."""
    try:
        described = json.loads(text)
        if isinstance(described, int):
            return case_of(described)
        faults = tuple((kind_with(kind, rest[0]) or _ALL_KINDS[kind])(*rest) for kind, *rest in described["faults"])
        scenario, ahead = Scenario(described["scenario"]), described.get("ahead", MOST_SLOTS_AHEAD)
        hosts = DrawnHosts.of_lists(described["hosts"]) if "hosts" in described else None
        program = DrawnProgram(*described["program"]) if "program" in described else None
        return SimulatedCase(described["seed"], scenario, faults, ahead, hosts, program)
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"not a case ({type(error).__name__}: {error}); expected a seed or a shrunk case") from error


def case_of(seed: int) -> SimulatedCase:
    """The case of a seed, and of nothing else."""
    scenario = scenario_of(seed // SEEDS_OF_A_SCENARIO)
    source = random.Random(f"case {seed}")  # noqa: S311 - to be repeated, not to be secret
    few = [ahead for ahead in _AHEAD if 2 * ahead <= scenario.slots]
    ahead = source.choice(few if few and source.random() < _LIMITED else _AHEAD)
    hosts, of_hosts = drawn_hosts(seed, scenario)
    faults = (*faults_of(source, scenario, ahead), *of_hosts, *rare_faults(seed, scenario, ahead))
    program = drawn_program(seed, scenario) if hosts is None else None
    if program is not None:  # what such a run takes is known from its files alone
        wrong: tuple[type[Disturbance], ...] = BreakMessage, ShortenMessage
        if not program.listens:  # two sensors cannot listen at one place
            wrong += WriteBriefs, RunByHand
        faults = tuple(fault for fault in faults if not (fault.lacking or fault.amends or isinstance(fault, wrong)))
    return SimulatedCase(seed, scenario, faults, ahead, hosts, program)


def case_with(scenario: Scenario, seed: int) -> SimulatedCase:
    """The case of a seed with this scenario: what is drawn are the faults, and how far the sensor may be ahead."""
    source = random.Random(f"scenario {seed}")  # noqa: S311 - to be repeated, not to be secret
    few = [
        ahead for ahead in _AHEAD if scenario.slots <= _MOST_BLOCKS * ahead
    ]  # or a long run would have too many messages
    ahead = source.choice(few or [MOST_SLOTS_AHEAD])
    return SimulatedCase(seed, scenario, faults_of(source, scenario, ahead), ahead)
