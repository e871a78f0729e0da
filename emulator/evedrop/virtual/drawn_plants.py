"""What a drawn scenario may have besides: an eavesdropper that learns a state, an expectation, and more in a closed loop.

Source: docs/integrity.md.
"""

from __future__ import annotations

import random
from copy import deepcopy
from typing import Any

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import Scenario

_BETRAYED, _MEASURED, _DISTURBED, _COMFORTABLE = 0.05, 0.6, 0.4, 0.3
_EXPECTED = 0.1
"""The fraction of scenarios with an expectation."""
_UNWATCHED = 0.2
"""The fraction of sensors that measure without a detector."""


def with_more(number: int, scenario: Scenario) -> Scenario:
    """A drawn scenario, which has more for some numbers, as far as that fits."""
    some = random.Random(f"plant {number}")  # noqa: S311 - to be repeated, not to be secret
    tables = deepcopy(scenario.as_tables())
    of_loop = ((_MEASURED, _measure), (_DISTURBED, _disturb), (_COMFORTABLE, _comfort))
    added = (_BETRAYED, _betray), *(of_loop if scenario.controller is not None else ()), (_EXPECTED, _expect)
    for fraction, add in added:
        if some.random() < fraction:
            more = deepcopy(tables)
            add(some, more)
            try:
                scenario, tables = Scenario(more), more
            except ScenarioError:
                continue
    return scenario


def _betray(some: random.Random, tables: dict[str, Any]) -> None:
    for name, eavesdropper in tables.get("eavesdroppers", {}).items():
        learns = {"reads_as": some.choice(["smart", "naive"]), "learns_at": some.randrange(tables["slots"])}
        kept = {entry: value for entry, value in eavesdropper.items() if entry in {"link", "window"}}
        tables["eavesdroppers"][name] = {"strategy": "replay-informed", **learns, **kept}
        return


def _expect(some: random.Random, tables: dict[str, Any]) -> None:
    tables["expect"] = [{"metric": "legitimate.mean_squared_error", "below": some.choice([1e-9, 1e9])}]


def _measure(some: random.Random, tables: dict[str, Any]) -> None:
    tables["process"] |= {"Q": "filter", "initial_covariance": "filter"}
    tables["plant"] |= {"output_matrix": [[1.0, 0.0]], "measurement_noise": [[0.1]]}
    if some.random() < _UNWATCHED:
        return
    tables["controller"] |= {"period": 1, "acts_on": "estimate"}
    tables["integrity"] = {"policy": "always", "threshold": some.choice([1.0, 8.0])}
    if some.random() < 0.7:
        tables["integrity"]["watermark"] = [[0.3]]
    if some.random() < 0.7 and tables["slots"] > 2:
        first = some.randrange(1, tables["slots"])
        tables["integrity"]["attack"] = {"model": "replay", "recorded": some.randint(1, first)}
        spoof = {"from": first, "to": some.randint(first + 1, tables["slots"]), "spoof": "measurements"}
        tables["event"] = [*tables.get("event", []), spoof]


def _disturb(some: random.Random, tables: dict[str, Any]) -> None:
    values = [[round(some.gauss(0.0, 1.0), 2)] for _ in range(tables["slots"])]
    tables["plant"] |= {
        "disturbances": ["draught"],
        "disturbance_matrix": [[0.0], [-0.05]],
        "disturbance_values": values,
        "start": [1.0, 0.5],
    }


def _comfort(some: random.Random, tables: dict[str, Any]) -> None:
    del some
    tables["slot_seconds"] = 60.0
    tables["process"]["states"] = ["T_room", "T_wall"]
    tables["comfort"] = {"temperature": "T_room", "heater": "u", "lowest": -0.5, "highest": 0.5}
