"""Makes the status of a run in progress, for its operator.

Source: docs/protocol.md.
"""

from __future__ import annotations

from evedrop.live.protocol.status import LinkStatus, RunStatus
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.steering import Steering
from evedrop.model.metrics.links import LinkAccount
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally


def status_of(
    scenario: Scenario, done: int, rate: float, steering: Steering, conductor: Conductor, run_tally: RunTally
) -> RunStatus:
    """The status of a run; done: how many slots are scored; rate: slots per second."""
    accounts = {name: LinkAccount.of(tally) for name, tally in run_tally.tallies.items()}
    return RunStatus(
        slot=done,
        slots=scenario.slots,
        slots_per_second=0.0 if steering.paused else rate,
        state="paused" if steering.paused else "running" if steering.at is None else "held",
        processes=conductor.processes,
        links={name: LinkStatus.of(one.offered, one.delivered) for name, one in accounts.items()},
        events=steering.events,
    )
