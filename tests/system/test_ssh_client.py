"""The process of ssh: what the launcher sends through it."""

from __future__ import annotations

import tracemalloc

from evedrop.system.ssh_client import SystemSsh
from tests.conftest import LIMIT


def test_what_is_sent_in_many_parts_is_not_copied_for_each() -> None:
    """A brief may have 100 MB, and a pipe takes 64 KiB at a time: with a copy for each part, it would take minutes."""
    data = bytes(8_000_000)
    ssh = SystemSsh(["dd", "of=/dev/null", "bs=64k"])
    tracemalloc.start()
    try:
        assert ssh.send(data, LIMIT)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
        ssh.hang_up()
        assert ssh.wait(LIMIT) == 0
        said = ssh.said
        ssh.answers.close()
        ssh.close()
    assert "8000000 bytes" in said
