"""Runs whose links are those of a drawn wire: judged as any run, and its packets have the fates of the wire's messages.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import zenoh

from evedrop.cli.simulated import program
from evedrop.errors import ScenarioError, UsageError
from evedrop.names import LEGITIMATE, SENSOR
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked
from evedrop.scenario.tables import Scenario
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.cases import case_with
from evedrop.virtual.drawn_scenarios import CaseDraw
from evedrop.virtual.reference import in_memory
from evedrop.wire.file import wire_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.scenario_network import over_wire
from tests.virtual.wire_draws import BASE, ROBOT, Tables
from tests.virtual.wire_judge import fates_by_model

_DRAWS = 24
_KEYS = (f"{ROBOT}/data", f"{ROBOT}/data", f"{ROBOT}/data", "other", f"{ROBOT}/**", "//", None)
_MOST_SLOTS = 60
_SPARING = {"withholding", "scheduled"}
"""Schemes whose sensor does not send in every slot."""


def play_over_wire(tables: Tables, seed: int, keep: bool) -> tuple[PlayedCase | None, tuple[str, ...]]:
    """Play the first drawn scenario that can have the links of a wire, if there is one; returns the misses as well.

    Others are only drawn: they can have them, too, or the reasons why not are told. tables: of the wire; keep: whether to keep
    all events.
    """
    draw = random.Random(f"over a wire {seed}")  # noqa: S311 - to be repeated, not to be secret
    misses: list[str] = []
    played: PlayedCase | None = None
    for _ in range(_DRAWS):
        plan = wire_of(_eased(tables) if draw.random() < 0.7 else tables)
        listeners = [name for name in plan.sides if name != ROBOT]
        scenario, key = _drawn(draw), draw.choice(_KEYS)
        sides = {SENSOR: ROBOT, LEGITIMATE: BASE, **{name: draw.choice(listeners) for name in scenario.eavesdroppers}}
        if draw.random() < 0.1:
            sides["nobody"] = ROBOT
        if draw.random() < 0.1:
            del sides[SENSOR]
        try:
            over = checked(scenario.as_tables(), "wire", over_wire(scenario, plan, key, sides))
        except UsageError as error:
            if not isinstance(error, ScenarioError):
                misses += [line for line in str(error).splitlines() if not line.startswith("--wire: ")]
            continue
        if played is not None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            reference = in_memory(over, Path(folder))
            misses += _wrong_packets(plan, over, str(key), Results.read(folder))
            played = play_case(case_with(over, seed), program, keep, reference)
    return played, (*misses, *(() if played is None else played.misses))


def _eased(tables: Tables) -> Tables:
    """The wire without what no scenario can have, and with more events."""
    eased = deepcopy(tables)
    for link in eased["link"]:
        for entry in ("rate", "queue", "ordered"):
            link.pop(entry, None)
    eased["event"] = [event for event in eased.get("event", ()) if "rate" not in event.get("set", {})]
    link, other = eased["link"][0], eased["link"][-1]
    eased["event"] += [
        *({"at": at, "link": link["name"], "set": {"corrupt": corrupt}} for at, corrupt in ((0.3, 0.2), (0.6, 0.4))),
        {"from": 0.7, "to": 0.8, "cut": other["name"]},
    ]
    return eased


def _drawn(draw: random.Random) -> Scenario:
    """A scenario; some have several trials, some no `slot_seconds`."""
    tables = CaseDraw(draw).scenario().as_tables()
    tables["slots"] = min(tables["slots"], _MOST_SLOTS)
    tables.pop("event", None)
    if draw.random() < 0.8:
        tables["slot_seconds"] = draw.choice((0.05, 0.2))
    if draw.random() < 0.5:
        tables |= {"trials": 1, "record_trials": 1}
        tables.pop("shards", None)
    return Scenario(tables)


def _wrong_packets(plan: WirePlan, scenario: Scenario, key: str, results: Results) -> Iterator[str]:
    """The packet of slot k has the fate of message k of the wire, if nothing happens to the link, and nothing delays it."""
    expression = zenoh.KeyExpr(key)
    if scenario.trials > 1 or scenario.event or plan.is_lossless(expression) or scenario.wire is None:
        return
    for receiver, name in scenario.wire.links.items():
        link = plan.named(name)
        if "delay" in link.settings:
            continue
        codes = fates_by_model(link, plan.seed, "put", key, scenario.slots).codes[:, 0]
        got = [row["received_fraction"] == 1.0 for row in results.slots.to_pylist() if row["peer"] == receiver]
        sent = [True] * scenario.slots if scenario.encoding.spec["scheme"] not in _SPARING else got
        if got != [code == 0 and there for code, there in zip(codes, sent, strict=True)]:
            yield f"{receiver} does not get the packets that the link {name} lets through"
