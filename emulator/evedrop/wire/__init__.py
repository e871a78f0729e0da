"""A wire: links with faults between programs that know nothing of Evedrop, over Zenoh. docs/wire/.

    from evedrop import wire

    with wire("robot.toml") as radio:
        program = connect(radio.endpoint("robot"))
        radio.partition("robot", "base")

The package itself can be called, so that its name and the function's are one: a function of this name in `evedrop` would be
replaced by the package as soon as one of its modules is imported.
"""

from __future__ import annotations

import sys
from types import ModuleType

# Not from typing, as in `evedrop`: every command imports this module.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from evedrop.wire.running import RunningWire


class _Wire(ModuleType):
    """A package that can be called."""

    def __call__(self, *arguments: Any, **entries: Any) -> RunningWire:
        """A wire in a process of its own; the arguments are those of `evedrop.wire.running.wire`."""
        from evedrop.wire.running import wire  # noqa: PLC0415 - needed only when it is called

        return wire(*arguments, **entries)


sys.modules[__name__].__class__ = _Wire
