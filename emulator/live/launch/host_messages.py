"""The messages between a launcher and the program that starts processes for it on another host, over ssh.

Each message is one JSON object on a line. The launcher's have an entry `start`, `signal` or `silence`, the host's `evedrop`,
`log` or `ended`. Closing the launcher's side ends everything on the host.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from typing import Any

MOST_NOISE = 200
"""The most lines that the login shell of a host may print before the program begins."""


def line_of(message: Mapping[str, Any]) -> bytes:
    """A message as a line."""
    return json.dumps(message).encode() + b"\n"


def message_in(line: bytes) -> dict[str, Any]:
    """The message of a line. Raises ValueError if it is not one."""
    found = json.loads(line)
    if not isinstance(found, dict):
        raise ValueError(f"{line[:80]!r} is not a message")
    return found


def own_version() -> str:
    """The version of Evedrop, which must be the same on all hosts."""
    return importlib.metadata.version("evedrop")
