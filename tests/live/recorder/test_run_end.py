"""How a run ends, as its recorder tells it."""

from __future__ import annotations

import pytest

from evedrop.errors import RunError, UnwrittenResults
from evedrop.live.recorder.run_end import RunEnd


@pytest.mark.parametrize(("error", "suspects"), [(RunError("why"), ("eve",)), (UnwrittenResults("no space"), ())])
def test_nobody_is_blamed_for_a_disk(error: RunError, suspects: tuple[str, ...]) -> None:
    """A process that is cut off while the disk is full has not filled it."""
    end = RunEnd()
    end.blame(["eve"], error)
    assert end.suspects == suspects
