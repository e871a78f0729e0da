"""A real process of a run, started as ever, in which one thing is done otherwise."""

from __future__ import annotations

import os

from tests.conftest import Evedrop

ROGUE = """
import dataclasses
import evedrop.peers.sensor
from evedrop.live.network import reporting
from evedrop.live.protocol.packets import uplink
from evedrop.live.protocol.telemetry import Journal, Report
from evedrop.live.protocol.codec import pack

def change(how, honest=Report.pack):
    Report.pack = lambda self: honest(dataclasses.replace(self, **how(self)))

def packets(how):
    evedrop.peers.sensor.uplink = lambda k, z: how(k, z) if k else uplink(k, z)

"""


def with_rogue(evedrop: Evedrop, name: str, does: str) -> dict[str, str]:
    """The environment in which the process of that name does something else than it should."""
    begin = f"import sys\nif sys.orig_argv[-1].endswith('/{name}.json'):\n    import rogue\n"
    (evedrop.folder / "sitecustomize.py").write_text(begin)
    (evedrop.folder / "rogue.py").write_text(ROGUE + does + "\n")
    found = os.environ.get("PYTHONPATH", "")
    return {**evedrop.environment, "PYTHONPATH": f"{evedrop.folder}{os.pathsep}{found}".rstrip(os.pathsep)}
