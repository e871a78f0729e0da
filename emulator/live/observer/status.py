"""The status of a run that goes on, for its operator.

Source: docs/protocol.md.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from evedrop.figures.links import LinkAccount
from evedrop.live.observer.conductor import Conductor
from evedrop.live.observer.steering import Steering
from evedrop.scenario import Scenario
from evedrop.score.totals import Totals


def status_of(
    scenario: Scenario, done: int, rate: float, steering: Steering, conductor: Conductor, totals: Totals
) -> dict[str, Any]:
    """The status of a run; done: how many slots are done; rate: slots per second."""
    links = {}
    for name, tally in totals.tallies.items():
        account = LinkAccount.of(tally)
        fraction = account.delivered / account.offered if account.offered else None
        links[name] = {"offered": account.offered, "delivered": account.delivered, "fraction": fraction}
    return {
        "slot": done,
        "slots": scenario.slots,
        "slots_per_second": 0.0 if steering.paused else rate,
        "state": "paused" if steering.paused else "running" if steering.at is None else "held",
        "processes": conductor.processes,
        "links": links,
        "events": [asdict(event) for event in steering.events],
    }
