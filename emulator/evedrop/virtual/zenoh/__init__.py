"""The simulated Zenoh: sessions, routers, and the connections between them.

Only what the programs of a run and a wire use is simulated. `tests/virtual/test_zenoh.py` and `test_zenoh_for_wires.py` there
hold its behaviours against the real Zenoh.

Source: docs/maintainers/simulated-world.md.
"""

from evedrop.virtual.zenoh.network import VirtualZenoh

__all__ = ["VirtualZenoh"]
