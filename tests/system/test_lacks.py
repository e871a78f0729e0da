"""What a run imports early."""

from __future__ import annotations

import subprocess
import sys


def test_what_a_summary_needs_is_imported_on_a_thread() -> None:
    """A run goes on meanwhile."""
    program = (
        "import sys, threading; from evedrop.system.lacks import preload_meanwhile; preload_meanwhile(); "
        "[thread.join() for thread in threading.enumerate() if thread.name == 'preload']; print('scipy.special' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "True"
