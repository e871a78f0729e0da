"""Values are read as objects of declared types in any thread."""

from __future__ import annotations

import subprocess
import sys

import msgspec
import pytest

from evedrop.system.structs import converted

FIRST_USES = '''
import sys, threading, types
from evedrop.system.structs import converted

sys.setswitchinterval(1e-6)
DECLARED = """
from __future__ import annotations
from typing import Annotated
from msgspec import Meta, Struct

Slot = Annotated[int, Meta(ge=0)]

class Event(Struct):
    first: Slot
    names: list[str]
    why: str | None
    counts: dict[str, Slot]
    seconds: float
    slots: tuple[Slot, ...]
    last: Slot
"""
FIELDS = {"first": 1, "names": ["eve"], "why": None, "counts": {"eve": 1}, "seconds": 0.5, "slots": (1, 2), "last": 3}

for number in range(300):
    module = types.ModuleType(f"declared_{number}")
    sys.modules[module.__name__] = module
    exec(DECLARED, vars(module))
    together, read = threading.Barrier(4), []

    def use():
        together.wait()
        read.append(converted(FIELDS, module.Event))

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert read == [module.Event(**FIELDS)] * 4
'''


def test_threads_may_use_a_type_for_the_first_time_together() -> None:
    """Of msgspec alone, the process would crash in the first few of the 300 types."""
    done = subprocess.run([sys.executable, "-c", FIRST_USES], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_wrong_value_is_refused_at_every_use() -> None:
    """Also if the first value of a type was wrong."""

    class Pair(msgspec.Struct):
        left: int

    for _ in range(2):
        with pytest.raises(msgspec.ValidationError, match="missing required field `left`"):
            converted({}, Pair)
    assert converted({"left": 3}, Pair) == Pair(3)
