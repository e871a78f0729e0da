from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from evedrop.errors import Interrupted
from evedrop.live.recorder.conductor import Stop
from evedrop.system.signals import stop_on_signals
from tests.conftest import LIMIT


def test_what_is_ignored_from_birth_stays_ignored() -> None:
    """Under nohup a hang-up does not stop a study; Ctrl-C, SIGTERM and otherwise a hang-up do."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with stop_on_signals() as stop:
            signal.raise_signal(number)
            assert stop.wait(LIMIT)
    code = (
        "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from evedrop.system.signals import stop_on_signals\n"
        "with stop_on_signals() as stop:\n"
        "    signal.raise_signal(signal.SIGHUP)\n    print(stop.wait(0.5))\n"
        "    signal.raise_signal(signal.SIGTERM)\n    print(stop.wait(60))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_may_come_while_the_lock_of_the_event_is_held() -> None:
    """The main thread is stopped inside `Event.wait`: it must not wait for itself, and a hundred signals are as good as one."""
    code = (
        "import signal\nfrom evedrop.system.signals import stop_on_signals\n"
        "before = signal.getsignal(signal.SIGINT)\n"
        "with stop_on_signals() as stop:\n"
        "    with stop._cond:\n        for _ in range(100):\n            signal.raise_signal(signal.SIGINT)\n"
        "    print(stop.wait(60))\n"
        "print(signal.getsignal(signal.SIGINT) is before)\n"
    )
    command = [
        sys.executable,
        "-c",
        code,
    ]  # in a process of its own: one that waits for itself could not be ended otherwise
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT)
    assert done.stdout.split() == ["True", "True"]
    assert done.stderr == ""


def test_a_launcher_that_is_gone_is_known_without_waiting() -> None:
    """The other end of standard input is looked at, open with something to read in it, then closed."""
    code = (
        "from evedrop.live.network.launcher_pipe import launcher_is_gone\n"
        "print(launcher_is_gone(), flush=True)\ninput()\nprint(launcher_is_gone(), flush=True)\n"
        "while not launcher_is_gone():\n    pass\nprint('gone')\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "False\n"
        process.stdin.write("\nmore\n")
        process.stdin.flush()
        assert process.stdout.readline() == "False\n"
        process.stdin.close()
        assert process.stdout.readline() == "gone\n"


def test_a_run_without_its_launcher_is_interrupted_and_not_at_fault() -> None:
    """The others leave together with the launcher: a process that misses them looks for it, and for a signal, first."""
    Stop().check(0.01)
    with pytest.raises(Interrupted):
        Stop(orphaned=lambda: True).check()
    asked = Stop()
    asked.wanted = True
    with pytest.raises(Interrupted):
        asked.check()
