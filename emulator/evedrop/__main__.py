"""The command `evedrop`, also available as `python -m evedrop`."""

from __future__ import annotations

# The C module under `signal`; see `evedrop.system.signals`.
import _signal as signal  # type: ignore[import-not-found]
import atexit
import gc
import os
import sys

from evedrop.system.signals import heed_signals, heeded

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import NoReturn

_WITH_VALUES = ("--seed", "--set", "--over")
_HIDDEN = "..."
_COLLECT_AFTER = 50_000
"""New objects, before cycles among them are searched for: almost all that a command makes are its modules, and stay."""

_LIGHT = {
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "OPENBLAS_NUM_THREADS": "1",
    "PYDANTIC_DISABLE_PLUGINS": "__all__",
}
"""For this process alone, unless they are set: Arrow's own pool keeps 5 MB; threads for linear algebra, which workers do without
too, spin for a while even if they have nothing to do; plugins of pydantic, which we do not use, are searched for."""


def without_values(words: Sequence[str]) -> list[str]:
    """A command line for all users to read: without the values of options that may be a seed or a password."""
    shown: list[str] = []
    for word in words:
        name, equals, value = word.partition("=")
        before = shown[-1] if shown else ""
        if before in _WITH_VALUES:
            shown.append(_hidden(before, word))
        elif name in _WITH_VALUES and equals:
            shown.append(f"{name}={_hidden(name, value)}")
        else:
            shown.append(word)
    return shown


def _hidden(option: str, value: str) -> str:
    """The value of an option without what it says; the key of an entry stays."""
    key, equals, _ = value.partition("=")
    return f"{key}={_HIDDEN}" if equals and option != "--seed" else _HIDDEN


def hide_values() -> None:
    """Replace this process's command line, which all users of the machine can read, if it has values to hide."""
    words = without_values(sys.orig_argv)
    if words == sys.orig_argv:
        return
    from setproctitle import setproctitle  # noqa: PLC0415 - most commands need not wait for it

    os.environ["SPT_NOENV"] = "1"  # keep to the place of the command line: behind it is the environment
    setproctitle(" ".join(words))
    del os.environ["SPT_NOENV"]


def program() -> NoReturn:
    """Run the command line, and exit."""
    heed_signals()
    hide_values()

    from evedrop.cli.main import is_role, main  # noqa: PLC0415 - the handlers come first

    if is_role(sys.argv[1:]) or sys.argv[1:2] in (["wire"], ["view"]):
        # Threads may still be in Zenoh, or in Rerun: an interpreter that exits meanwhile aborts (Python 3.11), or hangs.
        os._exit(main())
    gc.set_threshold(_COLLECT_AFTER)
    for name, value in _LIGHT.items():
        os.environ.setdefault(name, value)
    status = main()
    for number in heeded():  # the command is over: ignore signals while it exits
        signal.signal(number, signal.SIG_IGN)
    if "threading" in sys.modules and sys.modules["threading"].active_count() > 1:
        sys.exit(status)  # waits for them
    # The interpreter would free every object of every module, which takes a quarter of a second after a study.
    atexit._run_exitfuncs()
    os._exit(status)


if __name__ == "__main__":
    program()
