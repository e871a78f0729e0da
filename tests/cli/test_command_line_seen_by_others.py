"""The command line of a process, as other users of the machine see it: without seeds and passwords."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.__main__ import without_values
from evedrop.system.environment import own_environment
from tests.conftest import Evedrop, wait_until

needs_proc = pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="only Linux has /proc")


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("run vehicle --seed 424242 --view off", "run vehicle --seed ... --view off"),
        ("run vehicle --seed=424242", "run vehicle --seed=..."),
        ("run --set seed=424242 vehicle --set title=a=b", "run --set seed=... vehicle --set title=..."),
        ("wire w.toml --set=side.a.users.b=word", "wire w.toml --set=side.a.users.b=..."),
        ("sweep v --over seed=1,2 --seed", "sweep v --over seed=... --seed"),
        ("run --set --seed 5", "run --set ... 5"),
        ("status runs/seed=4", "status runs/seed=4"),
    ],
)
def test_values_are_hidden(words: str, shown: str) -> None:
    """Those of a seed, and of every entry, whose key stays; nothing else."""
    assert without_values(words.split()) == shown.split()


@pytest.mark.thorough
@needs_proc
def test_a_running_command_shows_no_seed(evedrop: Evedrop) -> None:
    """Neither it nor any process that it starts, while the run goes on; its environment is as it was."""
    words = ("run", "eavesdroppers", "--seed", "424242", "--set", "legitimate.link.quality=0.91", "--pace", "0.05")
    live = evedrop.begun(*words, "--view", "off", "--slots", "400", "--out", "run")
    wait_until((evedrop.folder / "run" / "scenario.toml").exists, "a run that has begun")
    processes = [live.process.pid, *live.left()]
    for pid in processes:
        shown = Path(f"/proc/{pid}/cmdline").read_bytes()
        assert b"424242" not in shown
        assert b"0.91" not in shown
    assert b"--seed ..." in Path(f"/proc/{live.process.pid}/cmdline").read_bytes()
    assert str(evedrop.temporary).encode() in Path(f"/proc/{live.process.pid}/environ").read_bytes()
    live.process.terminate()
    live.end()


@needs_proc
def test_children_do_not_inherit_a_switch_of_the_title() -> None:
    """What hides the values leaves the environment as it was."""
    code = (
        "import os, sys; sys.orig_argv += ['--seed', '5']; from evedrop.__main__ import hide_values; hide_values(); "
        "print('SPT_NOENV' in os.environ)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=own_environment()
    )
    assert done.stdout == "False\n"
