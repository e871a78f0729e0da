"""Directs the processes of a run: what the recorder does again and again until all slots are joined.

Between two messages it carries out events, answers the operator, looks for lost connections, and for processes that hold up the
run.
"""

from __future__ import annotations

from contextlib import suppress
from typing import final

from evedrop.live.network.connection import Question
from evedrop.live.network.control_file import Control, remove_control
from evedrop.live.network.launcher_pipe import emit
from evedrop.live.network.operator import Answer, Order
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import ProcessStatus, ReportStatus, is_process_status, read_process_status
from evedrop.live.protocol.notices import RefusalNotice
from evedrop.live.protocol.requests import LinkStatus, RunStatus, StatusRequest
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.recorded_run import RecordedRun
from evedrop.live.recorder.recovery import Recovery, Stall, patience_of
from evedrop.live.recorder.steering import Steering
from evedrop.model.metrics.built_in import LinkAccount
from evedrop.names import CONTROLLER, OPERATOR
from evedrop.scenario.progress_events import Started
from evedrop.system.threads import Queue


def status_in(message: Reader, source: str, slots: int) -> ProcessStatus | None:
    """The status that a process reports; None for any other message. slots: of the run.

    Raises the refusal of which a process tells, or MalformedMessage.
    """
    refusal = RefusalNotice.read(message, source)
    if refusal is not None:
        raise refusal
    return read_process_status(message, slots) if is_process_status(message) else None


@final
class Direction:
    """Directs the processes of a run, whose slots `run` takes."""

    def __init__(
        self, conductor: Conductor, brief: Brief[RecorderPart], run: RecordedRun, confirmations: Queue[bytes]
    ) -> None:
        """confirmations: the launcher's, each with the number of an event."""
        scenario, flow = run.score.scenario, brief.flow
        self._conductor, self._brief, self._run, self._confirmations = conductor, brief, run, confirmations
        self._joiner = run.joiner
        self._steering = Steering(scenario, conductor, emit, run.amend, paused=brief.part.paused)
        self._recovery = Recovery(conductor, self._steering, flow, scenario.pace, emit)
        program = scenario.process.source == "zenoh"
        patience = patience_of(flow.longest_outage, scenario.pace, flow.batch, program)
        self._stall = Stall(patience, flow.batch, lambda: conductor.send_to_all(ReportStatus()), conductor.hub)
        score = run.score
        score.events, score.outages = self._steering.events, self._recovery.outages  # which grow
        score.misdelivered = conductor.dropped

    def start(self) -> None:
        """Wait for all processes, and let the sensor begin. Raises RunError if some do not appear, Interrupted."""
        self._conductor.assemble()
        self._run.start()
        part = self._brief.part
        control = Control(self._brief.run, self._brief.router, OPERATOR, part.operator, part.operator_identity)
        control.write(self._run.folder.now)
        self._conductor.start()
        emit(Started())

    def take_message(self) -> None:
        """Take the next message, if there is one within a moment. Raises Interrupted if the run was told to end."""
        item = self._conductor.next_message()
        if item is None:
            return
        source, payload = item
        message = Reader(self._conductor.keys[source], payload)
        status = status_in(message, source, self._run.score.scenario.slots)
        if status is not None:
            self._stall.add_answer(source, status)
            return
        before = self._joiner.settled
        self._run.take(source, message, self._steering)
        if self._joiner.settled > before:
            self._conductor.report_progress(self._joiner.settled)

    def steer(self) -> None:
        """Take the launcher's confirmations and the operator's questions, and carry out due events."""
        while not self._confirmations.empty():
            self._steering.done(int(self._confirmations.get_nowait()))
        while not self._conductor.questions.empty():
            self._answer(self._conductor.questions.get_nowait())
        self._steering.carry_on(
            self._joiner.done, self._places, lambda late: self._stall.held_up_by(late, self._places())
        )
        self._run.view.note(self._steering.events)

    def look_after(self) -> None:
        """Recover from lost connections. Raises RunError if a process is lost for too long, or holds up the run."""
        done, at = self._joiner.done, self._steering.at
        self._recovery.poll(done)
        held = at is not None and done >= at
        if held:
            self._run.progress.start(done)
        # Slots are joined without the controller's reports, until the sensor waits for them.
        flow = self._brief.flow
        owed = self._run.score.all_joined or done - self._joiner.settled >= flow.window - flow.batch
        unneeded = () if owed else (CONTROLLER,)
        missing = bool(self._conductor.missing)
        belief = held and self._steering.awaits_belief
        self._stall.poll(done, self._places, unneeded, held=held, missing=missing, belief=belief)

    def _places(self) -> dict[str, int]:
        """Process → the first slot that it has not reported, except for those away because the scenario says so."""
        reporters = self._run.score.scenario.digested
        return self._joiner.places(name for name in reporters if name not in self._conductor.absent)

    def dismiss(self) -> None:
        """Remove the control file of the run, which is over, answer all open questions, and close open outages."""
        complete = self._run.score.all_joined
        with suppress(FileNotFoundError):
            remove_control(self._run.folder.now)
        self._steering.answer_open_orders(self._joiner.done, complete=complete)
        while not self._conductor.questions.empty():
            self._conductor.questions.get_nowait().answer(Answer(refused=("the run is over",)).pack())
        self._recovery.give_up(self._joiner.done, complete=complete)

    def _answer(self, question: Question) -> None:
        """Take a question from the operator; a malformed one is refused and does not harm the run."""
        order = Order.of(question)
        if order is None:
            return
        if isinstance(order.request, StatusRequest):
            order.answer(Answer(status=self._status()))
        elif self._brief.part.shard:
            order.refuse("this run is in shards, which cannot be steered; run it with --set shards=1 to steer it")
        else:
            self._steering.take_order(order, self._joiner.done)

    def _status(self) -> RunStatus:
        run, steering = self._run, self._steering
        accounts = {name: LinkAccount.of(tally) for name, tally in run.score.run_tally.tallies.items()}
        return RunStatus(
            slot=self._joiner.done,
            slots=run.score.scenario.slots,
            slots_per_second=0.0 if steering.paused else run.progress.rate(self._joiner.done),
            state="paused" if steering.paused else "running" if steering.at is None else "held",
            processes=self._conductor.present,
            links={name: LinkStatus.of(account.offered, account.delivered) for name, account in accounts.items()},
            events=steering.events,
        )
