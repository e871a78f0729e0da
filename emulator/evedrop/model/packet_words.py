"""The words for packets in the tables of results and in recordings: their types, and what a receiver did with them.

Source: docs/results.md, tables.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.receiver import Action

STATE = "state"
INNOVATION = "innovation"
NOTHING = "nothing"
"""In tables: the sensor sent no packet."""
SILENT = "silent"
"""The same in recordings and pictures, whose lanes have one word for each slot."""
DROPPED = "dropped"
DISCARDED = "discarded"
MISLED = "misled"
"""The receiver used an innovation as the state."""

TYPES = (STATE, INNOVATION, NOTHING)
"""What the sensor sent. The index of a word of a packet is ν."""
ACTIONS = (DROPPED, STATE, INNOVATION, DISCARDED, MISLED)
"""A receiver's actions as the recorder knows them. The index of a word is its `Action`, except for the last one."""
ACTION_OF: Mapping[str, Action] = {
    DROPPED: Action.LOST,
    STATE: Action.STATE,
    INNOVATION: Action.INNOVATION,
    DISCARDED: Action.DISCARDED,
    MISLED: Action.STATE,
}
"""The word of an action → the action as the receiver knows it."""
