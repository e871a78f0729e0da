"""A real process of a run, started as ever, in which one thing is done otherwise."""

from __future__ import annotations

import os

from tests.conftest import Evedrop

BEGIN = """
import os
import sys

begun = []

def opened(event, values):
    if event == "open" and str(values[0]).endswith("/{name}.json") and not values[2] & (os.O_WRONLY | os.O_RDWR) and not begun:
        begun.append(values)
        import rogue

sys.addaudithook(opened)
"""
"""When the process of a name reads its brief, it becomes another."""
ROGUE = """
import dataclasses
import evedrop.peers.sensor
from evedrop.live.network import reporting
from evedrop.live.protocol.packets import uplink
from evedrop.live.protocol.telemetry import Journal, Report
from evedrop.live.protocol.codec import pack

def change(how, honest=Report.pack):
    def changed(self):
        parts = how(self)
        of_report = {name: parts.pop(name) for name in ("digests", "trace_sums") if name in parts}
        return dataclasses.replace(self, slots=dataclasses.replace(self.slots, **parts), **of_report)

    Report.pack = lambda self: honest(changed(self))

def packets(how):
    evedrop.peers.sensor.uplink = lambda slots: uplink(how(slots) if slots.first else slots)

"""


def with_rogue(evedrop: Evedrop, name: str, does: str) -> dict[str, str]:
    """The environment in which the process of that name does something else than it should."""
    (evedrop.folder / "sitecustomize.py").write_text(BEGIN.format(name=name))
    (evedrop.folder / "rogue.py").write_text(ROGUE + does + "\n")
    path = os.environ.get("PYTHONPATH", "")
    return {**evedrop.environment, "PYTHONPATH": f"{evedrop.folder}{os.pathsep}{path}".rstrip(os.pathsep)}
