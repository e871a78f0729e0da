"""README's two commands do what they promise on bare Debian, with and without a compiler."""

from __future__ import annotations

import re
import sys

import pytest

from tests.folders import temporary_folder
from tests.fresh.machine import COMMANDS, Machine, Outcome, outcome
from tests.privileged import CannotRun, skip

pytestmark = pytest.mark.fresh


def test_a_newcomers_commands_succeed_on_a_bare_machine(machine: Machine, outcomes: dict[str, Outcome]) -> None:
    """Both commands end with 0, and leave no process, and no file in /tmp and /dev/shm; setting up downloads what it says."""

    def write(line: str) -> None:
        # The machine's own banners are not this machine's.
        sys.stdout.write(f"{machine.name} | {line}")
        sys.stdout.flush()

    with temporary_folder("evedrop-fresh-") as folder:
        try:
            outcomes[machine.name] = outcome(machine, folder, write)
        except CannotRun as error:
            skip(error)
    text = "\n".join(outcomes[machine.name].lines)
    sizes = [re.search(pattern, text) for pattern in (r"about (\d+) MB to download", r"(\d+) MB downloaded")]
    announced, downloaded = (int(size[1]) if size else 0 for size in sizes)
    assert announced == pytest.approx(downloaded, rel=0.15), "tools/install.py announces another size than it downloads"
    assert not (mistakes := outcomes[machine.name].mistakes(COMMANDS)), "\n".join(mistakes)
