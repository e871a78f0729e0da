"""Shows a wire while it runs: in a window, on a page for browsers, or only in a file.

Neither Rerun nor the viewer is loaded before a view is asked for.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.show.view.viewer import Viewer, choose
from evedrop.system.output import warn
from evedrop.wire.plan import WirePlan

if TYPE_CHECKING:
    from evedrop.wire.view import WireView


@contextmanager
def live_view(plan: WirePlan, out: Path, mode: str, say: Callable[[str], None]) -> Iterator[WireView | None]:
    """A view of a wire that starts now, for the time of a `with` block; None for "off".

    mode: as `evedrop run --view`, or the name of a file that ends in .rrd: the recording is written there, and nothing is shown.
    out: the wire's folder. say: for the line with the address of the page.

    Raises UsageError for any other mode, and if a viewer cannot be started.
    """
    to_file = mode.endswith(".rrd")
    shown = "off" if to_file else choose(mode)
    if shown == "off" and not to_file:
        yield None
        return
    from evedrop.wire.view import WireView  # noqa: PLC0415 - loads Rerun

    path = Path(mode) if to_file else out.absolute() / "recording.rrd"
    viewer = Viewer.start(shown, out / "logs", path)
    try:
        if viewer is not None and viewer.address is not None:
            say(f"the wire is shown at {viewer.address}, to anybody who has this address")
        if viewer is not None and viewer.warning is not None:
            warn(viewer.warning)
        view = WireView(path, plan, out.resolve().name, time.time())
        try:
            yield view
        finally:
            view.close()
            if view.failure is not None:
                warn(view.failure)
    finally:
        if viewer is not None:
            viewer.complete()
            viewer.stop()
