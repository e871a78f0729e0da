"""Reads values as objects of declared types, with msgspec, in any thread.

msgspec prepares a type when it is used for the first time. A thread that uses the type meanwhile finds the types of its fields
missing, and the process crashes (msgspec 0.22.0). So a lock is held while a type is used for the first time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import msgspec

_prepared: set[Any] = set()
_preparing = threading.RLock()  # one type may be used while another is prepared, by `dec_hook`


def converted(value: Any, kind: Any, dec_hook: Callable[[Any, Any], Any] | None = None) -> Any:
    """A value of JSON or msgpack as an object of this kind, as by `msgspec.convert`, which raises msgspec.ValidationError."""
    if kind in _prepared:
        return msgspec.convert(value, kind, dec_hook=dec_hook)
    with _preparing:
        try:
            return msgspec.convert(value, kind, dec_hook=dec_hook)
        finally:
            _prepared.add(kind)
