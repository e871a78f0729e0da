"""Which signals end a process whose main thread waits outside Python."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from evedrop.system.signals import INTERRUPTED

PROGRAM = (
    "import signal, sys, time\nfrom evedrop.system.signals import leave_on_signals\n"
    "handled = []\nsignal.signal(signal.SIGALRM, lambda *_: handled.append(1))\n"
    "leave_on_signals()\nsignal.raise_signal(signal.SIGALRM)\ntime.sleep(0.3)\n"
    "print(handled, flush=True)\nsignal.raise_signal(int(sys.argv[1]))\ntime.sleep(60.0)"
)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_only_signals_that_interrupt_end_a_process(number: signal.Signals) -> None:
    """Another signal, for which a library has a handler, is left to it."""
    words = [sys.executable, "-c", PROGRAM, str(int(number))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (INTERRUPTED, "[1]\n", "")


NESTED = (
    "import signal\nfrom evedrop.system.signals import stop_on_signals\n"
    "with stop_on_signals() as outer:\n"
    "    with stop_on_signals() as inner:\n"
    "        signal.raise_signal(signal.SIGTERM)\n"
    "        assert inner.wait(30.0)\n"
    "    print(outer.wait(30.0))\n"
    "    with stop_on_signals() as next:\n"
    "        print(next.is_set())\n"
    "with stop_on_signals() as later:\n"
    "    print(later.is_set())"
)


def test_a_signal_that_comes_as_an_inner_block_ends_is_not_lost() -> None:
    """`evedrop test` starts no further scenario or seed, even if the one that goes on ends by itself and says nothing."""
    done = subprocess.run([sys.executable, "-c", NESTED], capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\nTrue\nFalse\n", "")
