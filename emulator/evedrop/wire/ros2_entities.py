"""The names behind the gids of a wire's journal: every entity of ROS 2 that the wire has seen, in a file of the same folder.

Source: docs/ros2.md, the journal.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Final, final

from evedrop.system.output import warn
from evedrop.wire.ros2 import read_token

ENTITIES: Final = "ros2.jsonl"
"""The file inside a wire's folder that has a line for each entity: side, gid, kind, node, topic, type and QoS."""
MOST_ENTITIES = 65_536
"""The most lines that one start of a wire writes."""


@final
class EntityLog:
    """Writes down each entity of ROS 2 once, as its liveliness token describes it, when its token first appears.

    A file that cannot be written ends the log with a warning; the wire continues.
    """

    def __init__(self, folder: Path) -> None:
        self._path: Path | None = folder / ENTITIES
        self._known: set[tuple[str, str]] = set()

    def add(self, side: str, token: str) -> None:
        """Note a token of a program at a side; a token that is not of rmw_zenoh is ignored."""
        if self._path is None or (side, token) in self._known or len(self._known) >= MOST_ENTITIES:
            return
        entity = read_token(token)
        if entity is None:
            return
        self._known.add((side, token))
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"side": side, **asdict(entity)}) + "\n")
        except OSError as error:
            warn(f"{self._path} lacks entities of ROS 2 from now on ({error.strerror}); the wire and its journal go on")
            self._path = None
