"""How a run ends, as the recorder tells it: the exit status, the reason, and the processes at fault."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import final

from evedrop.errors import EvedropError, FolderTaken, Interrupted, NoAnswer, RunError, UnwrittenResults
from evedrop.live.protocol.last_word import protocol_breaker
from evedrop.names import RELAY, ROUTER
from evedrop.results.summary_file import unwritten
from evedrop.scenario.progress_events import RunEnded
from evedrop.score.scorekeeper import RunOutcome
from evedrop.score.summary import Summary
from evedrop.system.lacks import lack_of


@final
@dataclass
class RunEnd:
    """How a run ends, as far as that is known."""

    status: int = 0
    """The exit status."""
    how: str = RunOutcome.how
    """`complete`, `interrupted`, or why it failed."""
    saved: bool = True
    """Whether all rows are on disk."""
    suspects: tuple[str, ...] = ()
    """Processes that were missing when the run failed."""
    accused: tuple[str, ...] = ()
    """Processes whose misbehaviour ended the run."""
    broken_by: str | None = None
    """The process whose message broke the protocol, if that ended the run."""

    def fail(self, how: str) -> None:
        """Note that the run failed, and why, unless it has failed before: what comes later has not made it fail."""
        if self.status != RunError.exit_status:
            self.status, self.how = RunError.exit_status, how
            self.suspects, self.accused, self.broken_by = (), (), None

    def take(self, error: EvedropError) -> None:
        """Note the error that ended the run."""
        self.status, self.how = error.exit_status, reason_of(error)

    def blame(self, missing: list[str], error: EvedropError) -> None:
        """Note which processes are at fault for the error; missing: those that are not on the network."""
        if isinstance(error, RunError) and error.missing:  # others may be waiting for these, or missing just now
            missing = [*error.missing]
        # Without the router no other process can be seen.
        missing = next(([name] for name in (RELAY, ROUTER) if name in missing), missing)
        # Some may be missing just now, too: a cut connection does not fill the disk.
        self.suspects = () if isinstance(error, UnwrittenResults) else tuple(missing)
        self.accused = error.at_fault if isinstance(error, RunError) else ()
        self.broken_by = protocol_breaker(error)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note why the block fails, if it does, and go on: no error may cost the results.

        Raises FolderTaken: the results there are another run's.
        """
        try:
            yield
        except FolderTaken:
            raise
        except OSError as error:
            self.saved = False
            self.fail(reason_of(error))
        except NoAnswer as error:  # of a class that is asked again after the operator's change of a link
            self.fail(f"an eavesdropper's class could not give its theoretical covariance: {error}")
        except Exception as error:  # a bug in the recorder
            if lack_of(error) is None:
                traceback.print_exc()
            self.fail(reason_of(error))

    def judge(self, summary: Summary) -> None:
        """Note what the summary of a run that seemed to be complete says against it."""
        if self.status == 0 and any(link.unexplained for link in summary.links.values()):
            self.fail("packets are unaccounted for: see links.*.unexplained, and look at the router's log")
        if self.status == 0 and summary.ended != self.how:  # a metric failed
            self.fail(summary.ended)
        if self.status == 0 and summary.failed_expectations:
            self.status = 1

    def event(self, view: str | None) -> RunEnded:
        """What the launcher is told; view: why the view failed, if it did."""
        return RunEnded(self.status, self.how, self.suspects, self.accused, view, self.broken_by)


def reason_of(error: Exception) -> str:
    """Why a run ended with this error, in words."""
    if isinstance(error, Interrupted):
        return "interrupted"
    if isinstance(error, EvedropError):
        return str(error)
    if isinstance(error, OSError):
        return unwritten(error)
    return lack_of(error) or f"the recorder failed ({error!r}); please report its log"
