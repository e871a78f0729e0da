"""The observer: the only process that sees truth and every estimate. It conducts, scores, records and feeds the view.

Its news go to standard output, a JSON object a line: every second `{"event": "alive"}`; `{"event": "started"}`, then four
times a second `{"event": "progress", …}`, then `{"event": "over"}` if all slots are done, `{"event": "finishing"}`
and `{"event": "ended", "status": …}`. Whatever ends the run, the results folder is whole. An observer that was started by
hand then prints the table and the verdict that `evedrop run` prints.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from dataclasses import replace
from queue import SimpleQueue

from evedrop.errors import EvedropError, Interrupted, NoAnswer, RunError
from evedrop.interrupts import heeded
from evedrop.live.network.launcher_watch import launcher_is_gone, when_launcher_is_gone
from evedrop.live.network.session import Session
from evedrop.live.observer.conductor import Stop
from evedrop.live.observer.news import set_news_apart, tell
from evedrop.live.observer.observation import ObservedRun, Report
from evedrop.live.protocol.brief import Brief
from evedrop.model.eavesdroppers import ANSWERS
from evedrop.results.folder import new_folder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.summary_file import unwritten
from evedrop.scenario import Scenario
from evedrop.view.viewer import WebAddress

_ORPHAN_SECONDS = 30.0  # to write the results when the launcher is gone


def observe(brief: Brief, report: Report, serve: str | None = None) -> int:
    """Run the observer of a brief; the exit status of the run.

    report: prints how a run ended that was started by hand. serve: HOST:PORT where browsers may see it, if anywhere.
    Raises UsageError, BriefError, RunError or Interrupted, of one started by hand, as long as nothing has begun.
    """
    stand = None if serve is None else WebAddress.of(serve)
    stop, confirmations = Stop(launcher_is_gone if brief.ends_with_stdin else lambda: False), SimpleQueue[bytes]()
    for number in heeded():
        signal.signal(number, lambda *_: setattr(stop, "wanted", True))
    set_news_apart()
    by_hand = not brief.ends_with_stdin
    if not by_hand:
        when_launcher_is_gone(_end_orphaned, confirmations.put)
        brief = replace(brief, ends_with_stdin=False)
    ANSWERS.learn(brief.part["classes"])  # so that the classes themselves need not run here
    scenario = Scenario.model_validate(brief.part["scenario"])
    observation = ObservedRun(brief, scenario, confirmations, by_hand)
    if by_hand:
        # Before there is anything in it: what a brief that does not fit leaves behind would be in the next one's way.
        new_folder(observation.folder)
        with Session(brief, meanwhile=stop.check):
            pass
    viewer = None if stand is None else observation.show(stand)
    status, how = 0, "complete"
    try:
        observation.hold()
        write_resolved(observation.folder, scenario)
        with observation.writer():
            try:
                observation.conduct(stop)
            except EvedropError as error:
                status, how = error.exit_status, "interrupted" if isinstance(error, Interrupted) else str(error)
            finally:
                tell("finishing")
            observation.settle(how)
    except OSError as error:
        status, how = RunError.exit_status, how if status == RunError.exit_status else unwritten(error)
    except NoAnswer as error:  # of a class that the operator's change of a link has a question for
        status, how = RunError.exit_status, f"an eavesdropper's class could not say what theory expects of it: {error}"
    except Exception as error:  # a mistake of ours must not cost what was measured
        traceback.print_exc()
        status, how = RunError.exit_status, f"the observer failed ({error!r}); please report its log"
    status = observation.finish(status, how, report)
    if viewer is not None:
        viewer.stop()
    return status


def _end_orphaned() -> None:
    """Write what there is, and end."""
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_ORPHAN_SECONDS)
    os._exit(RunError.exit_status)
