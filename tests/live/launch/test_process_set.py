"""What a launcher starts first."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

import pytest

from evedrop.errors import Interrupted
from evedrop.live.launch import process_set
from evedrop.live.launch.starter import StartedProcess
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.show.view.viewer import Viewer


def test_no_process_waits_for_a_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer may take minutes to start, and processes wait 30 s for each other; Ctrl-C is heeded meanwhile."""
    stop = threading.Event()

    def slow(*_: object, meanwhile: Callable[[], None], **__: object) -> None:
        meanwhile()
        stop.set()
        meanwhile()

    def never(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        del role, brief, log, environment
        raise AssertionError("a process was started before the viewer")

    monkeypatch.setattr(Viewer, "start", slow)
    with pytest.raises(Interrupted):
        process_set.launch_one(
            process_set.Launch(load("eavesdroppers"), tmp_path / "run", "web", lambda _: None, stop, never)
        )
    assert Results.read(tmp_path / "run").summary["ended"] == "interrupted"
