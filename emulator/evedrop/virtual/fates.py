"""The journal that a run must write, from the fates that the link model decides in memory, counted here packet by packet.

Source: docs/results.md, tables.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from evedrop.model.links.loss_model import Fate
from evedrop.model.slot.link import Fates
from evedrop.scenario.tables import Scenario
from evedrop.simulate.simulation import Simulation

_LOSSES = ("lost", "corrupted", "overflow", "cut", "late", "down", "paused", "underway")
_DELIVERED, _UNSENT = Fate.DELIVERED.value, Fate.UNSENT.value


def journal_rows(scenario: Scenario) -> Iterator[dict[str, Any]]:
    """The rows of `journal.parquet` for all slots and links of a scenario, whose trials are simulated for it."""
    trials = range(scenario.first_trial, scenario.first_trial + scenario.trials)
    for chunk in Simulation(scenario, trials).chunks():
        for name, receiver in chunk.receivers.items():
            for row in range(len(receiver.error)):
                yield {"slot": chunk.first + row, "link": name, **_row(receiver.fates, row)}


def _row(fates: Fates, row: int) -> dict[str, Any]:
    """The counts of one slot of one link, and the mask of the trials whose packet arrived in that slot."""
    codes = [int(code) for code in fates.codes[row]]
    delays = [0] * len(codes) if fates.delays is None else [int(delay) for delay in fates.delays[row]]
    mask = bytearray(-(-len(codes) // 8))
    counts = dict.fromkeys(_LOSSES, 0)
    offered = delivered = late = 0
    for trial, (code, delay) in enumerate(zip(codes, delays, strict=True)):
        if code == _UNSENT:
            continue
        offered += 1
        if code != _DELIVERED:
            counts[Fate(code).name.lower()] += 1
        elif delay:
            late += 1
        else:
            delivered += 1
            mask[trial // 8] |= 1 << trial % 8
    by_reason = {f"lost_by_{reason}": count for reason, count in counts.items()}
    lost = sum(counts.values())
    return {"offered": offered, "delivered": delivered, "late": late, "lost": lost, **by_reason,
            "delivered_mask": bytes(mask)}  # fmt: skip
