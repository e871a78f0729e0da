"""Memory that is kept for large messages."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_MESSAGES = 100
_PROGRAM = f"""
import resource, sys
import evedrop.system.allocator
if sys.argv[1] == "kept":
    evedrop.system.allocator.keep_for_messages(1 << 20)
def message():
    packed = bytes(1 << 20)
    with_key = b"key" + packed
    return len(with_key + b"copy")
for _ in range(10):
    message()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({_MESSAGES}):
    message()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(how: str) -> int:
    """The pages that the system cleared for a hundred messages of 1 MiB."""
    run = subprocess.run([sys.executable, "-c", _PROGRAM, how], check=True, capture_output=True, text=True, timeout=60)
    return int(run.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of the GNU C library")
def test_memory_of_large_messages_is_kept() -> None:
    """Without that, every message's pages are cleared again."""
    assert page_faults("kept") < _MESSAGES
