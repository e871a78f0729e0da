"""The recorder: the only process that sees truth and every estimate. It conducts, scores, records and feeds the view.

Its events go to standard output, one JSON object per line: every second `{"event": "alive"}`; `{"event": "started"}`, then four
times a second `{"event": "progress", …}`, then `{"event": "over"}` if all slots are done, `{"event": "finishing"}`
and `{"event": "ended", "status": …}`. However the run ends, the results folder is complete. A recorder started by hand
then prints the same table and verdict as `evedrop run`.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from dataclasses import replace
from queue import SimpleQueue

from evedrop.errors import EvedropError, Interrupted, NoAnswer, RunError
from evedrop.live.network.launcher_pipe import emit, keep_events_apart
from evedrop.live.network.launcher_watchdog import launcher_is_gone, when_launcher_is_gone
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import Brief
from evedrop.live.protocol.brief_parts import RecorderPart
from evedrop.live.protocol.launcher_events import SaveStarted
from evedrop.live.recorder.conductor import Stop
from evedrop.live.recorder.recorded_run import EndPrinter, RecordedRun
from evedrop.model.eavesdroppers import REMOTE_CALLS
from evedrop.results.folder import new_folder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.summary_file import unwritten
from evedrop.scenario.tables import Scenario
from evedrop.show.view.viewer import WebAddress
from evedrop.system.lacks import lack_of, preload_within_limit
from evedrop.system.signals import heeded

_ORPHAN_SECONDS = 30.0  # to write the results once the launcher is gone


def record(brief: Brief[RecorderPart], report: EndPrinter, serve: str | None = None) -> int:
    """Run the recorder of a brief; returns the exit status of the run.

    report: prints the end of a run that was started by hand. serve: HOST:PORT where browsers may see the run, if anywhere.
    Raises UsageError, BriefError, RunError or Interrupted only before the run has begun, and if started by hand.
    """
    web_address = None if serve is None else WebAddress.of(serve)
    stop, confirmations = Stop(launcher_is_gone if brief.ends_with_stdin else lambda: False), SimpleQueue[bytes]()
    for number in heeded():
        signal.signal(number, lambda *_: setattr(stop, "wanted", True))
    preload_within_limit()
    by_hand = not brief.ends_with_stdin
    keep_events_apart(launched=not by_hand)
    if not by_hand:
        when_launcher_is_gone(_end_orphaned, confirmations.put)
        brief = replace(brief, ends_with_stdin=False)
    REMOTE_CALLS.learn(brief.part.classes)  # so that the recorder need not import the classes themselves
    scenario = Scenario.read(brief.part.scenario)
    run = RecordedRun(brief, scenario, confirmations, by_hand)
    if by_hand:
        # Connect before writing to the folder: files left by a brief that does not fit would block the next attempt.
        new_folder(run.folder)
        with Session(brief, meanwhile=stop.check):
            pass
    viewer = None if web_address is None else run.show(web_address)
    status, how, saved = 0, "complete", True
    try:
        run.hold()
        write_resolved(run.folder, scenario)
        with run.writer():
            try:
                run.conduct(stop)
            except EvedropError as error:
                status, how = error.exit_status, "interrupted" if isinstance(error, Interrupted) else str(error)
            finally:
                emit(SaveStarted())
            run.settle(how)
    except OSError as error:
        saved = False
        status, how = RunError.exit_status, how if status == RunError.exit_status else unwritten(error)
    except NoAnswer as error:  # of a class that is asked again after the operator's change of a link
        status, how = (
            RunError.exit_status,
            f"an eavesdropper's class could not give the covariance expected of it: {error}",
        )
    except Exception as error:  # a bug in the recorder must not cost the results
        status, lack = RunError.exit_status, lack_of(error)
        if lack is None:
            traceback.print_exc()
        how = lack or f"the recorder failed ({error!r}); please report its log"
    status = run.finish(status, how, report, saved)
    if viewer is not None:
        viewer.stop()
    return status


def _end_orphaned() -> None:
    """Write the results so far, and exit."""
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_ORPHAN_SECONDS)
    os._exit(RunError.exit_status)
