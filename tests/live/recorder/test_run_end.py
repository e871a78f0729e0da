"""How a run ends, as its recorder tells it."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from evedrop.errors import RunError, UnwrittenResults
from evedrop.live.recorder.run_end import RunEnd


@pytest.mark.parametrize(("error", "suspects"), [(RunError("why"), ("eve",)), (UnwrittenResults("no space"), ())])
def test_nobody_is_blamed_for_a_disk(error: RunError, suspects: tuple[str, ...]) -> None:
    """A process that is cut off while the disk is full has not filled it."""
    end = RunEnd()
    end.blame(["eve"], error)
    assert end.suspects == suspects


@pytest.mark.parametrize(("unexplained", "status"), [(0, 0), (1, 3)])
def test_a_run_with_packets_that_are_unaccounted_for_has_failed(unexplained: int, status: int) -> None:
    """Even if all its slots are done."""
    links = {"legitimate": Mock(unexplained=0), "eve": Mock(unexplained=unexplained)}
    end = RunEnd()
    end.judge(Mock(links=links, ended=end.how, failed_expectations=()))
    assert end.status == status
