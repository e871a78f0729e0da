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
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, final

from evedrop.errors import EvedropError, Interrupted, NoAnswer, RunError
from evedrop.live.network.connection import Question
from evedrop.live.network.control_file import Control, remove_control
from evedrop.live.network.launcher_pipe import emit, keep_events_apart, launcher_is_gone, when_launcher_is_gone
from evedrop.live.network.operator import Answer, Order
from evedrop.live.network.process_session import GapDetector
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader, is_refusal, read_refusal
from evedrop.live.protocol.commands import ReportStatus, is_process_status, read_process_status
from evedrop.live.protocol.last_word import protocol_breaker
from evedrop.live.protocol.launcher_events import SaveStarted, SlotsDone
from evedrop.live.protocol.requests import RunStatus, StatusRequest
from evedrop.live.protocol.telemetry import is_held, is_leaving, read_leaving
from evedrop.live.recorder.conductor import Conductor, Stop
from evedrop.live.recorder.joiner import AbsenceReporter, Joiner
from evedrop.live.recorder.recovery import Recovery, Stall, patience_of
from evedrop.live.recorder.steering import Steering, status_of
from evedrop.live.recorder.verification import Verifier, extent_of
from evedrop.model.digest import Blocks
from evedrop.model.eavesdroppers import REMOTE_CALLS
from evedrop.names import CONTROLLER, OPERATOR, RECORDER, ROUTER, SENSOR
from evedrop.results.ending import note_end
from evedrop.results.folder import HeldFolder, new_folder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.shard_score import dump_score
from evedrop.results.summary_file import unwritten, write_summary
from evedrop.results.writer import DigestRows, ResultsWriter, write_rows
from evedrop.scenario.progress_events import ConnectionOutage, RunEnded, RunEvent, RunProgress, Started, ViewOpened
from evedrop.scenario.tables import Scenario
from evedrop.score.expectations_held import replay_of
from evedrop.score.scorekeeper import RunOutcome, Scored, Scorekeeper, digest_of, summary_of
from evedrop.score.summary import Summary
from evedrop.show.view.scene_slots import loop_values_of, open_recording, shown
from evedrop.show.view.viewer import Viewer, WebAddress
from evedrop.system.lacks import lack_of, preload_within_limit
from evedrop.system.signals import heeded

if TYPE_CHECKING:
    from evedrop.show.view.recording import ViewRecording
    from evedrop.show.view.scene_slots import LoopValues


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
            f"an eavesdropper's class could not give its theoretical covariance: {error}",
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


EndPrinter = Callable[[Path, int, str], None]
"""Prints the end of a run, from its results folder, its exit status, and the reason for a failure."""
_PROGRESS_SECONDS = 0.25


@final
class RecordedRun:
    """The recorder's work on one run."""

    def __init__(
        self, brief: Brief[RecorderPart], scenario: Scenario, confirmations: SimpleQueue[bytes], by_hand: bool = False
    ) -> None:
        """by_hand: whether the processes were started by hand, so that there is no launcher to end them."""
        self._place = Path(brief.part.results)
        self._held: HeldFolder | None = None
        self._final: Summary | None = None
        self._brief = brief
        self._by_hand = by_hand
        self._scenario = scenario
        windows = {name: scenario.window(name) for name in scenario.receivers}
        blocks = {name: Blocks(scenario.slots, scenario.outage_bounds(name)) for name in scenario.digested}
        table = scenario.controller
        self._extent = extent_of(scenario, brief.flow.batch)
        self._verifier = Verifier(blocks, scenario.record_trials, scenario.first_trial)
        period = None if table is None else table.period
        self._joiner = Joiner(self._extent, windows, blocks, period, self._verifier.report)
        self._digest_rows = DigestRows(self._joiner.digests, scenario.first_trial)
        self._confirmations = confirmations
        self._steering: Steering
        self._events: list[RunEvent] = []
        self._absent: dict[str, AbsenceReporter] = {}
        self._keeper = Scorekeeper(scenario, scenario.trials)
        self._recording: ViewRecording | None = None
        self._loop_values: LoopValues | None = None
        self._writer: ResultsWriter
        self._started = self._ended = self._told = time.monotonic()
        self._suspects: list[str] = []
        self._accused: tuple[str, ...] = ()
        """Processes whose misbehaviour ended the run."""
        self._broken_by: str | None = None
        """The process whose message broke the protocol, if that ended the run."""
        self._recovery: Recovery
        self._stall: Stall
        self._outages: list[ConnectionOutage] = []
        self._misdelivered: dict[str, int] = {}
        self._due: dict[str, GapDetector] = {}
        self._recent: tuple[float, int] = (self._started, 0)

    @property
    def folder(self) -> Path:
        """The results folder, even if it was renamed. Raises FileNotFoundError if it was removed."""
        return self._place if self._held is None else self._held.now

    def hold(self) -> None:
        """Open the results folder, so that it is found even if it is renamed. Raises OSError if it does not exist."""
        self._held = HeldFolder(self._place)

    def show(self, web_address: WebAddress) -> Viewer:
        """Start a viewer for browsers at this address, which follows the recording of the run."""
        viewer = Viewer.serve(web_address, self.folder / "recording.rrd")
        emit(ViewOpened(viewer.address))
        return viewer

    def writer(self) -> ResultsWriter:
        """The writer of the results folder, to be entered around `conduct`."""
        self._writer = ResultsWriter.of(self.folder, self._scenario, self._dump_score)
        return self._writer

    def conduct(self, stop: Stop) -> None:
        """Conduct the run to its end. Raises RunError if it fails, Interrupted if it was told to end."""
        with Session(self._brief, meanwhile=stop.check) as session:
            conductor = Conductor(session, self._scenario.digested, stop, self._scenario.relayed)
            if self._brief.part.recording:
                self._loop_values = loop_values_of(self._scenario)
                path = self.folder / "recording.rrd"
                self._recording = open_recording(
                    self._scenario, self._brief.run, path, lambda text: emit(ViewOpened(None, text))
                )
            self._steering = Steering(self._scenario, conductor, emit, self._keep, paused=self._brief.part.paused)
            patience = self._brief.flow.longest_outage
            self._due = {source: GapDetector(key, patience) for source, key in conductor.keys.items()}
            self._recovery = Recovery(conductor, self._steering, self._brief.flow, self._scenario.pace, emit)
            program = self._scenario.process.source == "zenoh"
            limit = patience_of(patience, self._scenario.pace, self._brief.flow.batch, program)
            self._stall = Stall(limit, self._brief.flow.batch, lambda: conductor.send_to_all(ReportStatus()))
            try:
                conductor.assemble()
                self._started = self._ended = time.monotonic()
                self._recent = (self._started, 0)
                self._control.write(self.folder)
                conductor.start()
                emit(Started())
                while not self._joiner.complete(self._scenario.slots):
                    item = conductor.next_message()
                    if item is not None:
                        self._take(conductor, *item)
                    self._steer(conductor)
                    self._recovery.poll(self._joiner.done)
                    self._save()
                    self._poll(conductor)
                self._save_rows()  # processes may take long to confirm their end, and this one may be killed meanwhile
            except EvedropError as error:
                self._blame(conductor.missing, error)
                if self._by_hand:  # a launcher ends them itself
                    conductor.abandon("interrupted" if isinstance(error, Interrupted) else str(error))
                raise
            finally:
                self._dismiss(conductor)
                self._recovery.give_up(self._joiner.done, complete=self._joiner.done == self._scenario.slots)
                self._outages = self._recovery.outages
                self._ended = time.monotonic()
            emit(SlotsDone())
            try:
                conductor.end(patience)
            finally:
                self._misdelivered = {name: count for name, count in conductor.misdelivered.items() if count}
                if session.dropped:
                    self._misdelivered[RECORDER] = session.dropped

    def _blame(self, missing: list[str], error: EvedropError) -> None:
        """Note which processes are at fault for the end of the run, as far as this process can know."""
        self._suspects = missing
        self._accused = error.at_fault if isinstance(error, RunError) else ()
        self._broken_by = protocol_breaker(error)

    def _poll(self, conductor: Conductor) -> None:
        """Check whether the run stands still because of a process that is present. Raises Silence."""
        done, at = self._joiner.done, self._steering.at
        held = at is not None and done >= at
        present = set(self._scenario.digested) - conductor.absent
        unneeded = (CONTROLLER,) if done < self._scenario.slots else ()
        missing = bool(conductor.missing)
        self._stall.poll(done, lambda: self._joiner.places(present), unneeded, held=held, missing=missing)

    @property
    def _control(self) -> Control:
        part = self._brief.part
        return Control(self._brief.run, self._brief.router, OPERATOR, part.operator, part.operator_identity)

    def _keep(self, scenario: Scenario) -> None:
        """Replace the scenario with one that the operator has amended; it is the same for the slots so far."""
        self._scenario = scenario
        write_resolved(self.folder, scenario)

    def _steer(self, conductor: Conductor) -> None:
        """Handle confirmations from the launcher and questions from the operator, and carry out due events."""
        while not self._confirmations.empty():
            self._steering.done(int(self._confirmations.get_nowait()))
        while not conductor.questions.empty():
            self._answer(conductor, conductor.questions.get_nowait())
        self._steering.carry_on(self._joiner.done)
        for event in self._steering.events[len(self._events) :]:
            self._events.append(event)
            if self._recording is not None:
                self._recording.note(event.slot, "INFO", event.line)

    def _answer(self, conductor: Conductor, question: Question) -> None:
        """Take a question from the operator; a malformed one is refused and does not harm the run."""
        order = Order.of(question)
        if order is None:
            return
        if isinstance(order.request, StatusRequest):
            order.answer(Answer(status=self._status(conductor)))
        elif self._brief.part.shard:
            order.refuse("this run is in shards, which cannot be steered; run it with --set shards=1 to steer it")
        else:
            self._steering.take_order(order, self._joiner.done)

    def _dismiss(self, conductor: Conductor) -> None:
        """Remove the control file of the run, which is over, and answer all open questions."""
        with suppress(FileNotFoundError):
            remove_control(self.folder)
        self._steering.answer_open_orders(self._joiner.done, complete=self._joiner.done == self._scenario.slots)
        while not conductor.questions.empty():
            conductor.questions.get_nowait().answer(Answer(refused=("the run is over",)).pack())

    def _status(self, conductor: Conductor) -> RunStatus:
        """The status of the run."""
        before, done = self._recent
        rate = (self._joiner.done - done) / max(time.monotonic() - before, 1e-3)
        return status_of(self._scenario, self._joiner.done, rate, self._steering, conductor, self._keeper.run_tally)

    def _take(self, conductor: Conductor, source: str, payload: bytes) -> None:
        message = Reader(conductor.keys[source], payload)
        if is_refusal(message):
            raise read_refusal(message, source)
        if is_process_status(message):
            self._stall.add_answer(source, read_process_status(message, self._scenario.slots))
            return
        if not self._is_due(source, message):
            return
        if source == ROUTER:
            for name, account in self._joiner.add_journal(message).items():
                self._keeper.run_tally.tallies[name].count(account)
        elif source == CONTROLLER:
            self._keeper.run_tally.solve_times.add_seconds(self._joiner.add_decisions(message).tolist())
        elif source != SENSOR and is_leaving(message):
            self._leave(source, message)
        elif source != SENSOR:
            self._joiner.add_report(source, message)
        elif is_held(message):
            self._steering.held(message.slot(self._joiner.sent))
        else:
            self._joiner.add_truth(message)
        self._report_absences()
        slots = self._joiner.take_slots()
        if slots is None:
            return
        self._verifier.joined(slots)
        scored = self._keeper.add_slots(slots)
        write_rows(self._writer, slots, scored, self._scenario.first_trial)
        self._digest_rows.write(self._writer)
        if self._recording is not None:
            self._recording.add(shown(slots, scored, self._scenario.process.around, self._loop_values))
        conductor.report_progress(self._joiner.done)
        self._progress(scored)

    def _report_absences(self) -> None:
        """Report on behalf of receivers that are away."""
        for name, reporter in list(self._absent.items()):
            if self._joiner.reported(name) == reporter.next:
                reporter.follow(self._joiner.sent)
            if reporter.over:
                del self._absent[name]

    def _is_due(self, source: str, message: Reader) -> bool:
        """Whether a message is the next one from its source; after losses, earlier and later ones arrive, too."""
        slot = message.integer("k")
        if source not in (ROUTER, SENSOR) and is_leaving(message):  # comes before the reports of the slots before it
            return not self._steering.has_left(source, slot)
        joiner = self._joiner
        due = {ROUTER: joiner.journaled, SENSOR: joiner.sent}.get(source)
        due = joiner.reported(source) if due is None else due
        if slot != due:
            self._due[source].missed(due, slot)
        return slot == due

    def _leave(self, name: str, message: Reader) -> None:
        """Report on behalf of a receiver until it is back."""
        k, left = read_leaving(message, self._extent)
        away = next((outage for outage in self._scenario.timeline.outages[name] if outage.start == k), None)
        if away is None:
            raise message.malformed(
                f"a leave before slot {k}", "a leave at a slot where an event makes the receiver leave"
            )
        key = message.key

        def put(payload: bytes) -> None:
            self._joiner.add_report(name, Reader(key, payload))

        self._verifier.left(name, k, left)
        self._steering.left(name, k)
        self._absent[name] = AbsenceReporter(self._brief, self._scenario, name, away, left, put)

    def _progress(self, scored: Mapping[str, Scored]) -> None:
        now = time.monotonic()
        if now - self._told < _PROGRESS_SECONDS:
            return
        before, done = self._recent
        rate = (self._joiner.done - done) / (now - before)
        self._told, self._recent = now, (now, self._joiner.done)
        errors = {name: float(score.squared_error.mean()) for name, score in scored.items()}
        emit(RunProgress(self._joiner.done, rate, "slots/s", errors))

    @property
    def _at(self) -> str:
        """How far the run has come, in words."""
        return f"slot {self._joiner.done}"

    def _save_rows(self) -> None:
        """Save all rows. Raises RunError if they cannot be written."""
        try:
            self._writer.write_rows(self._at)
        except OSError as error:
            raise RunError(unwritten(error)) from error

    def _save(self) -> None:
        """Save the results so far, from time to time. Raises RunError if they cannot be written."""
        try:
            with suppress(NoAnswer):  # reported at the end; rows are written before the summary is computed
                self._writer.checkpoint(self._at, self._so_far)
        except OSError as error:
            raise RunError(unwritten(error)) from error

    def _so_far(self) -> Summary:
        """The summary of the slots so far."""
        self._ended = time.monotonic()
        return self._summary("")

    def _summary(self, how: str) -> Summary:
        if self._joiner.done == self._scenario.slots:
            for name, sums in self._joiner.trace_sums.items():
                self._keeper.run_tally.tallies[name].know_traces(sums)
        digests = {name: digest_of(self._scenario, name, blocks) for name, blocks in self._joiner.digests.items()}
        replay, wall = replay_of(self.folder, self._scenario), self._ended - self._started
        ending = RunOutcome(
            wall,
            how,
            replay,
            events=self._events,
            outages=self._outages,
            accused=self._accused,
            misdelivered=self._misdelivered,
        )
        return summary_of(self._scenario, self._keeper.run_tally, digests, ending)

    def _dump_score(self) -> None:
        """Dump the score of a shard, for the summary of the whole run. Raises OSError."""
        if self._brief.part.shard:
            dump_score(self._keeper.run_tally, self.folder, self._scenario)

    def settle(self, how: str) -> None:
        """Compute the summary, and save it and all rows to disk. Raises OSError if they cannot be written."""
        self._digest_rows.write(self._writer)
        self._final = self._summary(how)
        self._writer.settle(self._at, self._final)
        if self._scenario.process.source == "zenoh" and self._joiner.done == self._scenario.slots:
            write_resolved(self.folder, self._scenario, taken=True)

    def finish(self, status: int, how: str, report: EndPrinter, saved: bool = True) -> int:
        """Close the view, write the summary, and tell the launcher; returns the exit status of the run.

        report: prints how the run ended, if it was started by hand. saved: whether all rows are on disk; otherwise the summary
        has the last metrics whose rows are.
        """
        safe = self._recording.close() if self._recording is not None else True
        try:
            summary = (self._final or self._summary(how)) if saved else note_end(self.folder, self._scenario, how)
            if status == 0 and any(link.unexplained for link in summary.links.values()):
                status = RunError.exit_status
                how = "packets are unaccounted for: see links.*.unexplained, and look at the router's log"
            if status == 0 and summary.ended != how:  # a metric failed
                status, how = RunError.exit_status, summary.ended
            if status == 0 and summary.failed_expectations:
                status = 1
            if saved:
                if self._final is None:
                    self._dump_score()
                write_summary(self.folder, replace(summary, ended=how))
        except OSError as error:
            status, how = RunError.exit_status, unwritten(error)
        view = self._recording.failure if self._recording is not None else None
        emit(RunEnded(status, how, self._suspects, self._accused, view, self._broken_by))
        if self._by_hand:
            with suppress(FileNotFoundError):
                report(self.folder, status, how)
        if not safe:
            os._exit(status)
        return status
