import signal
import subprocess
import sys


def test_what_is_ignored_from_birth_stays_ignored() -> None:
    """Under nohup a hang-up does not stop a study; Ctrl-C and SIGTERM do."""
    code = (
        "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from emulator.runs.signals import stop_on_signals\n"
        "with stop_on_signals() as stop:\n"
        "    signal.raise_signal(signal.SIGHUP)\n    print(stop.is_set())\n"
        "    signal.raise_signal(signal.SIGTERM)\n    print(stop.is_set())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
