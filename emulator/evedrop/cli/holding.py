"""Keeps a view open until it is closed or Ctrl-C ends it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evedrop.show.view.viewer import Viewer


def hold(viewer: Viewer) -> None:
    """Wait until the view is closed, or end it on Ctrl-C or SIGTERM."""
    from evedrop.system.signals import stop_on_signals

    with stop_on_signals() as stop:
        while viewer.alive() and not stop.wait(0.1):
            pass
    viewer.stop()
