"""The environment of the processes we start: what they need to run, and nothing else that the launcher happens to have.

A token in the launcher's environment is nobody else's business, least of all an eavesdropper's.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

_NEEDED = frozenset(
    {
        *(
            "PATH",
            "HOME",
            "LANG",
            "LANGUAGE",
            "TZ",
            "TMPDIR",
            "TEMP",
            "TMP",
            "VIRTUAL_ENV",
            "RUST_LOG",
            "RUST_BACKTRACE",
        ),
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
    """For a process of a run, or a worker: where programs, libraries and temporary files are, and how to speak."""
    return {name: value for name, value in os.environ.items() if name in _NEEDED or name.startswith(_NEEDED_KINDS)}


_CLIENT = "(rx: (worker_threads: 1), tx: (handover: rx), net: (handover: rx), acc: (handover: rx), app: (handover: rx))"
# What a router receives must never wait for a thread that sends what it passes on.
_ROUTER = (
    "(rx: (worker_threads: 1), tx: (worker_threads: 1), net: (handover: tx), acc: (handover: tx), app: (handover: tx))"
)


def lock_step_environment(role: str) -> dict[str, str]:
    """For a process of a run whose messages come one by one: few threads of Zenoh, for each must be woken for each message."""
    return {"ZENOH_RUNTIME": _ROUTER if role == "router" else _CLIENT}


def viewer_environment() -> Mapping[str, str]:
    """For a viewer: besides, how to reach the screen and the graphics card."""
    shows = {name: value for name, value in os.environ.items() if name in _SHOWING or name.startswith(_SHOWING_KINDS)}
    return {**own_environment(), **shows}
