"""Scenarios drawn from a number: with any scheme, strategy, link and event.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache
from typing import Any, final

from evedrop.errors import ScenarioError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.loading import Scenario
from evedrop.virtual import own_classes
from evedrop.virtual.programs import with_states

_MOST_SLOTS, _MOST_TRIALS = 40, 4
_COSTLY: Mapping[str, Mapping[str, Any]] = {"learning-em": {"keeps": 4}, "learning-particle": {"particles": 4}}
"""Strategies that take longer than all other processes of a run together → how they take less."""
_PACES = (0.001, 0.01, 0.1, 0.3)
"""Seconds of a slot: a run of half a minute is written to the disk while it goes on, and outlasts the longest outage."""
_OWN = 0.03
"""The fraction of classes that are not built in."""
_RELAYED_SHARDS = 0.3
"""The fraction of the runs in shards with two routers in each."""
_UNSTABLE, _STABLE = 1.02, 0.9
_LOOP: Mapping[str, Any] = {
    "plant": {"inputs": ["u"], "input_matrix": [[0.1], [0.0]], "noise": [[1e-4, 0.0], [0.0, 1e-4]]},
    "controller": {"strategy": "lqr", "state_weights": [1.0, 1.0], "input_weights": [0.1]},
}


@lru_cache(maxsize=1)
def scenario_of(number: int) -> Scenario:
    """The scenario that some seeds play."""
    drawn = CaseDraw(random.Random(f"drawn {number}")).scenario()  # noqa: S311 - to be repeated, not to be secret
    return with_states(number, with_two_routers(number, with_more(number, drawn)))


def with_two_routers(number: int, scenario: Scenario) -> Scenario:
    """A drawn scenario, which has two routers in each shard for some numbers."""
    some = random.Random(f"routers {number}")  # noqa: S311 - to be repeated, not to be secret
    if scenario.shards == 1 or some.random() >= _RELAYED_SHARDS:
        return scenario
    return Scenario({**scenario.as_tables(), "network": {"routers": 2}})


@final
class CaseDraw:
    """Draws the parts of a scenario."""

    def __init__(self, source: random.Random) -> None:
        self.random = source

    def scenario(self) -> Scenario:
        """A scenario that fits together: a draw that does not is drawn again."""
        while True:
            try:
                return Scenario(self._tables())
            except ScenarioError:
                continue

    def _tables(self) -> dict[str, Any]:
        some, chance = self.random, self._chance
        trials = some.randint(1, _MOST_TRIALS)
        tables: dict[str, Any] = {
            "title": "Drawn",
            "slots": round(_MOST_SLOTS ** some.random() ** 0.7),
            "seed": some.getrandbits(32),
            "trials": trials,
            "record_trials": some.randint(1, trials),
            "longest_outage": some.choice([3.0, 30.0]),
            "pace": some.choice(_PACES) if chance(0.3) else 0.0,
            "process": self._process(),
            "encoding": self._encoding(),
            "legitimate": self._receiver(),
            "eavesdroppers": {f"eve{i}": self._eavesdropper() for i in range(some.randint(0, 3))},
        }
        if SCHEMES[tables["encoding"]["scheme"]].needs_acknowledgements:
            tables["acknowledgements"] = {"link": {"quality": self._quality()}}
            if chance(0.6) and tables["eavesdroppers"]:
                tables["acknowledgements"] |= {"attack": some.choice(["critical", "hijack"]), "jammer": "eve0"}
        if chance(0.2):
            tables |= _LOOP
            loop = {"period": some.randint(1, 4), "acts_on": some.choice(["truth", "estimate"])}
            tables["controller"] = {**tables["controller"], **loop}
            tables["legitimate"]["knows_input"] = chance(0.7)
        if chance(0.15):
            tables["network"] = {"routers": 2}
        if chance(0.15) and trials > 1 and "network" not in tables:
            tables["shards"] = 2
        if chance(0.5):
            tables["event"] = [self._event(tables) for _ in range(some.randint(1, 3))]
        return tables

    def _process(self) -> dict[str, Any]:
        growth = self.random.choice([_STABLE, 1.0, _UNSTABLE])
        return {
            "A": [[growth, 0.1], [0.0, 0.9]],
            "Q": [[0.01, 0.0], [0.0, 0.01]],
            "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
        }

    def _encoding(self) -> dict[str, Any]:
        name = own_classes.SCHEME if self._chance(_OWN) else self.random.choice(sorted(SCHEMES.names))
        return {"scheme": name, **SCHEMES[name].parameters}

    def _eavesdropper(self) -> dict[str, Any]:
        names = sorted(STRATEGIES.names)
        name = self.random.choice(names)
        if name in _COSTLY and self._chance(0.9):
            name = self.random.choice([cheap for cheap in names if cheap not in _COSTLY])
        if self._chance(_OWN / 3.0):  # it is asked in a process of its own, which takes a second
            name = own_classes.STRATEGY
        return {"strategy": name, **self._receiver(), **STRATEGIES[name].parameters, **_COSTLY.get(name, {})}

    def _receiver(self) -> dict[str, Any]:
        """The link of a receiver, and for how long a late packet is of use to it."""
        link = self._link()
        waits = self._chance(0.7 if "delay" in link else 0.1)
        return {"link": link, **({"window": self.random.randint(1, 4)} if waits else {})}

    def _link(self) -> dict[str, Any]:
        link: dict[str, Any] = {}
        if self._chance(0.5):
            link["quality"] = self._quality()
        else:
            name = own_classes.LOSS_MODEL if self._chance(_OWN) else self.random.choice(sorted(LOSS_MODELS.names))
            link["loss"] = {"model": name, **LOSS_MODELS[name].parameters}
        if self._chance(0.3):
            name = self.random.choice(sorted(DELAY_MODELS.names))
            link["delay"] = {"model": name, **DELAY_MODELS[name].parameters}
        if self._chance(0.2):
            link["duplicate"] = 0.1
        if self._chance(0.2):
            link["corrupt"] = 0.05
        return link

    def _event(self, tables: Mapping[str, Any]) -> dict[str, Any]:
        some, slots = self.random, int(tables["slots"])
        receiver = some.choice(["legitimate", *tables["eavesdroppers"]])
        first = some.randrange(slots)
        span = {"from": first, "to": some.randint(first + 1, slots)}
        kind = some.choice(["set", "kill", "kill", "pause", "pause", "cut"])
        if kind == "set":
            return {"at": first, "link": receiver, "set": {"quality": self._quality()}}
        return {**span, kind: receiver, **({"state": some.choice(["prior", "last"])} if kind == "kill" else {})}

    def _quality(self) -> float:
        return round(self.random.uniform(0.3, 1.0), 2)

    def _chance(self, probability: float) -> bool:
        return self.random.random() < probability


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
