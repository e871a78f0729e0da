"""A small run of the simulated world that is disturbed, for tests of what a fault does."""

from __future__ import annotations

from evedrop.cli.simulated import program
from evedrop.scenario.tables import Scenario
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_hosts import DrawnHosts

SCENARIO = Scenario(
    {
        "title": "A run that is disturbed",
        "slots": 40,
        "pace": 0.1,
        "longest_outage": 10.0,
        "process": {"A": [[1.0]], "Q": [[0.01]], "initial_covariance": [[1.0]]},
        "encoding": {"scheme": "plain"},
        "legitimate": {"link": {"quality": 0.9}},
        "eavesdroppers": {"eve": {"strategy": "naive", "link": {"quality": 0.9}}},
    }
)
RELAYED = Scenario({**SCENARIO.as_tables(), "network": {"routers": 2}})


def disturbed(
    *faults: Disturbance, scenario: Scenario = SCENARIO, hosts: DrawnHosts | None = None, seed: int = 1
) -> PlayedCase:
    """The run with these faults, each of which hits it; it keeps its promises."""
    played = play_case(SimulatedCase(seed, scenario, faults, hosts=hosts), program, keep=True)
    assert played.misses == ()
    assert set(played.struck) == set(faults)
    return played
