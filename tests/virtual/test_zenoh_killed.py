"""What becomes of a simulated session whose process is killed."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import zenoh

from evedrop.system.world import world
from evedrop.virtual.run import SimulatedWorld


def test_a_killed_process_is_told_nothing_of_the_end_of_its_handlers(tmp_path: Path) -> None:
    """No function of it is called any more, by whomever it is killed."""
    told: list[str] = []
    simulated = SimulatedWorld(1, lambda _: 1, tmp_path)

    def victim() -> int:
        session = world().zenoh.open(zenoh.Config.from_json5(json.dumps({"mode": "router"})))
        for indirect in (True, False):
            handler = world().zenoh.handlers.Callback(lambda _: None, lambda: told.append("end"), indirect=indirect)
            session.declare_subscriber("a", handler)
        told.append("declared")
        world().sleep(1000.0)
        return 0

    def killer() -> int:
        world().sleep(10.0)
        process.signal(signal.SIGKILL)
        world().sleep(10.0)
        return 0

    with simulated.entered():
        process = simulated.machine.begin("victim", victim)
        other = simulated.machine.begin("killer", killer)
        simulated.scheduler.run(100.0, lambda: not other.task.alive)
    assert simulated.scheduler.errors == []
    assert told == ["declared"]
