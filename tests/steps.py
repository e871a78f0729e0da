"""A run that begins paused and goes on by steps: it cannot be over before a test has done everything to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.commands import ForkedCommand
from tests.conftest import Evedrop, wait_until


@contextmanager
def stepping(evedrop: Evedrop, folder: Path, slots: int) -> Iterator[None]:
    """The block begins while a paused run, with its results in this folder, goes on for this number of slots; it ends paused.

    In the block the run may reach the last of these slots, and then it waits there.
    """
    run = str(folder)
    wait_until((folder / "control.json").is_file, "a run that can be steered")
    before = _steps(evedrop, run)
    step = ForkedCommand(("step", run, str(slots)), evedrop.environment, evedrop.folder)
    wait_until(lambda: _steps(evedrop, run) > before, "a step that is under way")
    yield
    # A router that is lost takes the answer of the step with it, and there may be nobody to ask until it is back.
    wait_until(lambda: evedrop("pause", run).status == 0, "a run that is paused again")
    step.communicate()


def _steps(evedrop: Evedrop, run: str) -> int:
    """How many steps a run has begun."""
    status = json.loads(evedrop("status", run, "--json").out)
    return sum(event["event"].startswith("step ") for event in status["events"])
