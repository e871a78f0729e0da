"""The environment of started processes: the variables that they need, and no others of the launcher's environment.

A token in the launcher's environment must not reach other processes, least of all an eavesdropper.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping

from evedrop.errors import UsageError
from evedrop.names import KERNELS_VARIABLE, RELAY, ROUTER

_NEEDED = frozenset(
    {
        KERNELS_VARIABLE,
        *("PATH", "HOME", "LANG", "LANGUAGE", "TZ", "TMPDIR", "TEMP", "TMP", "VIRTUAL_ENV"),
        *("RUST_LOG", "RUST_BACKTRACE"),
        *("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH"),
    }
)
_NEEDED_KINDS = ("LC_", "PYTHON", "ZENOH")
_SHOWING = frozenset({"DISPLAY", "WAYLAND_DISPLAY", "XAUTHORITY", "DBUS_SESSION_BUS_ADDRESS", "DRI_PRIME"})
_SHOWING_KINDS = (
    "XDG_",
    "XKB_",
    "WGPU_",
    "VK_",
    "MESA_",
    "LIBGL_",
    "GALLIUM_",
    "LP_",
    "EGL_",
    "__EGL_",
    "__GL",
    "__NV",
)


def own_environment() -> dict[str, str]:
    """For a process of a run, or a worker: where programs, libraries and temporary files are, and the language."""
    return {name: value for name, value in os.environ.items() if name in _NEEDED or name.startswith(_NEEDED_KINDS)}


SINGLE_THREADED: Mapping[str, str] = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
"""For a process of a run, or a worker: one thread for linear algebra, and output that is written at once."""

_CLIENT = "(rx: (worker_threads: 1), tx: (handover: rx), net: (handover: rx), acc: (handover: rx), app: (handover: rx))"
# A process that passes messages on must not receive on the thread that sends: the full queue it waits for would never empty.
_PASSES_ON = (
    "(rx: (worker_threads: 1), tx: (worker_threads: 1), net: (handover: tx), acc: (handover: tx), app: (handover: tx))"
)


def lock_step_environment(role: str) -> dict[str, str]:
    """For a process whose messages come one by one: few threads of Zenoh, since each message must wake each of them."""
    return {"ZENOH_RUNTIME": _PASSES_ON if role in {ROUTER, RELAY} else _CLIENT}


_THREADS = "(?:(?:worker|max_blocking)_threads *: *[0-9]{1,9}|handover *: *(?:rx|tx|net|acc|app))"
_PART = rf"(?:rx|tx|net|acc|app) *: *\( *(?:{_THREADS} *, *)*(?:{_THREADS} *)?\)"
_RUNTIME = re.compile(rf" *\( *(?:{_PART} *, *)*(?:{_PART} *)?\) *")


def check_zenoh_runtime() -> None:
    """Raise UsageError if `ZENOH_RUNTIME`, with which users give Zenoh more threads, is malformed: Zenoh itself would panic."""
    given = os.environ.get("ZENOH_RUNTIME")
    if given is None or (_RUNTIME.fullmatch(given) and not _names_twice(given)):
        return
    raise UsageError(
        f'the environment variable ZENOH_RUNTIME is "{given}", which Zenoh cannot read; unset it, or give parts of rx, tx, net, '
        'acc and app, such as "(rx: (worker_threads: 32))"'
    )


def _names_twice(given: str) -> bool:
    """Whether a well-formed value names a part twice, or an entry of a part."""
    parts = re.findall(r"(\w+) *: *\(([^)]*)\)", given)
    names = [[name for name, _ in parts], *(re.findall(r"(\w+) *:", inside) for _, inside in parts)]
    return any(len({*some}) < len(some) for some in names)


def viewer_environment() -> Mapping[str, str]:
    """For a viewer: also the variables for the screen and the graphics card."""
    shows = {name: value for name, value in os.environ.items() if name in _SHOWING or name.startswith(_SHOWING_KINDS)}
    return {**own_environment(), **shows}
