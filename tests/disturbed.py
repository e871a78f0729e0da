"""The scenario of runs that are disturbed: losses in bursts, delays and second copies; and what can be added to it."""

from __future__ import annotations

INNOVATION = 'scheme = "innovation"\nstate_probability = 0.5'
SCHEDULED = 'scheme = "scheduled"\nthreshold = 3'
ACKNOWLEDGED = """
[acknowledgements]
link = { quality = 0.8 }
attack = "critical"
jammer = "smart"
"""
LOOP = """
[plant]
inputs = ["heater"]
input_matrix = [[0.1], [0.0]]
input_lower = [-2.0]
input_upper = [2.0]
noise = [[1e-4, 0.0], [0.0, 1e-4]]
[controller]
strategy = "lqr"
state_weights = [1.0, 1.0]
input_weights = [0.1]
{}
"""
"""A closed loop; in the braces, more entries of the controller."""
_SCENARIO = """
title = "Disturbed"
seed = 20
slots = {slots}
trials = {trials}
pace = {pace}
{entries}
[process]
A = [[1.0, 0.1], [0.0, 0.98]]
Q = [[0.01, 0.0], [0.0, 0.01]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
{encoding}
[legitimate]
window = 3
{more_of_legitimate}
link = {{ quality = 0.8, delay = {{ model = "normal", mean = 1.0, standard_deviation = 1.0 }}, duplicate = 0.1, corrupt = 0.02 }}
[eavesdroppers.smart]
strategy = "{strategy}"
link = {{ loss = {{ model = "gilbert-elliott", p = 0.05, r = 0.3 }} }}
{more}
"""


def disturbed(
    slots: int,
    trials: int = 3,
    pace: float = 0.002,
    *,
    entries: str = "",
    encoding: str = INNOVATION,
    strategy: str = "smart",
    more_of_legitimate: str = "",
    more: str = "",
) -> str:
    """The scenario as TOML; entries, more: entries before its tables, and tables after them."""
    return _SCENARIO.format(
        slots=slots,
        trials=trials,
        pace=pace,
        entries=entries,
        encoding=encoding,
        strategy=strategy,
        more_of_legitimate=more_of_legitimate,
        more=more,
    )
