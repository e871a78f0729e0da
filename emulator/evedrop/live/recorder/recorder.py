"""The recorder: the only process that sees truth and every estimate. It conducts, scores, records and feeds the view.

`Direction` directs the processes: their commands (`Conductor`), events and the operator (`Steering`), lost connections and
silence (`Recovery`, `Stall`). Their messages go to `RecordedRun`: `Intake` joins them to slots, which are scored;
`RunFolder` writes and `RunView` shows them, and `RunScore` makes the summary. `RunEnd` says how the run ended.

Its events go to standard output, one JSON object per line: every second `{"event": "alive"}`; `{"event": "started"}`, then four
times a second `{"event": "progress", …}`, then `{"event": "over"}` if all slots are done, `{"event": "finishing"}`
and `{"event": "ended", "status": …}`. However the run ends, the results folder is complete. A recorder started by hand
then prints the same table and verdict as `evedrop run`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from evedrop.errors import EvedropError, RunError
from evedrop.live.network.launcher_pipe import emit, launcher_is_gone, when_launcher_is_gone
from evedrop.live.network.process_session import LEAST_SECONDS
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.launcher_events import SaveStarted, SlotsDone
from evedrop.live.recorder.conductor import Conductor, Stop
from evedrop.live.recorder.direction import Direction
from evedrop.live.recorder.recorded_run import RecordedRun
from evedrop.live.recorder.run_end import RunEnd, reason_of
from evedrop.model.eavesdroppers import REMOTE_CALLS
from evedrop.results.folder import new_folder
from evedrop.scenario.progress_events import ViewOpened
from evedrop.scenario.tables import Scenario
from evedrop.show.view.viewer import Viewer, WebAddress
from evedrop.system.lacks import preload_meanwhile, preload_within_limit
from evedrop.system.threads import Queue
from evedrop.system.world import world

_ORPHAN_SECONDS = 30.0  # to write the results once the launcher is gone

EndPrinter = Callable[[Path, int, str], None]
"""Prints the end of a run, from its results folder, its exit status, and the reason for a failure."""


def record(brief: Brief[RecorderPart], report: EndPrinter, serve: str | None = None) -> int:
    """Run the recorder of a brief; returns the exit status of the run.

    report: prints the end of a run that was started by hand. serve: HOST:PORT where browsers may see the run, if anywhere.
    Raises UsageError, BriefError, RunError or Interrupted only before the run has begun, and if started by hand.
    """
    web_address = None if serve is None else WebAddress.of(serve)
    stop, confirmations = Stop(launcher_is_gone if brief.ends_with_stdin else lambda: False), world().queue()
    world().process.on_signals(stop.want)
    preload_within_limit()
    by_hand = not brief.ends_with_stdin
    world().process.keep_events_apart(launched=not by_hand)
    if not by_hand:
        when_launcher_is_gone(_end_orphaned, confirmations.put)
        brief = replace(brief, ends_with_stdin=False)
    REMOTE_CALLS.learn(brief.part.classes)  # so that the recorder need not import the classes themselves
    run, end = RecordedRun(brief, Scenario.read(brief.part.scenario)), RunEnd()
    if by_hand:
        # Connect before writing to the folder: files left by a brief that does not fit would block the next attempt.
        new_folder(run.folder.now)
        with Session(brief, meanwhile=stop.check):
            pass
        new_folder(run.folder.now)  # another run may have begun there while this one waited for its router
    viewer = None if web_address is None else _serve(web_address, run.folder.now)
    with end.noted(), run.folder.open():
        with end.noted():  # whatever ended the run, the digests that have come get their rows
            try:
                _conduct(run, brief, stop, confirmations, end, by_hand=by_hand)
            except EvedropError as error:
                end.take(error)
        emit(SaveStarted())
        run.folder.settle(end)
    run.view.conclude(run.folder.verdict)
    usual_end = run.view.close()
    with suppress(OSError):
        run.view.remove_incomplete(run.folder.now / "recording.rrd")
    run.folder.complete(end)
    emit(end.event(run.view.failure))
    if by_hand:
        with suppress(FileNotFoundError):
            report(run.folder.now, end.status, end.how)
    if not usual_end:  # a thread of the view hangs
        world().process.exit(end.status)
    if viewer is not None:
        viewer.stop()
    return end.status


def _conduct(
    run: RecordedRun,
    brief: Brief[RecorderPart],
    stop: Stop,
    confirmations: Queue[bytes],
    end: RunEnd,
    *,
    by_hand: bool,
) -> None:
    """Conduct the run to its end. Raises RunError if it fails, Interrupted if it was told to end."""
    scenario = run.score.scenario
    with Session(brief, meanwhile=stop.check) as session:
        conductor = Conductor(session, scenario.digested, stop, scenario.relayed)
        if brief.part.recording:
            run.view.open(scenario, brief.run, run.folder.now / "recording.rrd")
        direction = Direction(conductor, brief, run, confirmations)
        try:
            direction.start()
            preload_meanwhile()
            while not run.joiner.complete(scenario.slots):
                direction.take_message()
                direction.steer()
                direction.look_after()
                run.folder.save()
            run.folder.save_rows()  # processes may take long to confirm their end, and this one may be killed meanwhile
        except Exception as error:
            if isinstance(error, EvedropError):
                end.blame(conductor.missing, error)
            if by_hand:  # a launcher ends them itself
                conductor.abandon(reason_of(error))
            raise
        finally:
            direction.dismiss()
            run.score.end()
        emit(SlotsDone())
        try:
            conductor.end(max(LEAST_SECONDS, brief.flow.longest_outage))
        except EvedropError as error:  # a message that breaks the protocol, although all slots are there
            end.blame([], error)
            if by_hand:
                conductor.abandon(reason_of(error))
            raise


def _serve(web_address: WebAddress, folder: Path) -> Viewer:
    """Start a viewer for browsers at this address, which follows the recording of the run."""
    viewer = Viewer.serve(web_address, folder / "recording.rrd")
    emit(ViewOpened(viewer.address))
    return viewer


def _end_orphaned() -> None:
    """Write the results so far, and exit."""
    world().process.interrupt()
    world().sleep(_ORPHAN_SECONDS)
    world().process.exit(RunError.exit_status)
