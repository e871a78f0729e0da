"""Programs that are no part of a run and do something to it: an operator's commands, and a stranger at a router.

They are processes of the simulated machine; one that gets what it must not have fails, which the judge reports.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, final

import zenoh

from evedrop.errors import UsageError
from evedrop.live.network.control_file import Control, read_controls
from evedrop.live.network.operator import read_answer
from evedrop.live.network.session import client_config
from evedrop.live.protocol.codec import enclosed, pack, payload_of
from evedrop.live.protocol.keys import RunKeys
from evedrop.names import RECORDER
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.processes import LAUNCHER
from evedrop.virtual.steered import Typed

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_AGAIN_SECONDS = 0.5
_LISTENS_SECONDS = 1.0
_LARGEST_GARBAGE = 3 << 20


class _Outsider(Disturbance):
    """A program that begins, and does something to the run."""

    program: ClassVar[str]
    """What its process is called."""
    only_target, harmless = "run", True

    def strike(self, world: SimulatedWorld) -> bool:
        """Begin it."""
        world.machine.begin(self.program, lambda: self._act(world))
        return True

    @abstractmethod
    def _act(self, world: SimulatedWorld) -> int:
        """What it does; returns its exit status."""


class OperatorCommand(_Outsider):
    """Somebody types commands."""

    program = "operator"

    @staticmethod
    def _type(world: SimulatedWorld, *words: str) -> bool:
        """Carry out a command, such as `pause RUN`; returns whether the run did it, rather than to refuse."""
        typed, printed = Typed(" ".join(words), here().monotonic()), len(world.machine.current.printed)
        world.typed.append(typed)
        status = world.machine.program([words[0], str(world.results_now), *words[1:]])
        typed.answered, typed.status = here().monotonic(), status
        typed.said = world.machine.current.printed[printed:]
        if status not in {0, UsageError.exit_status}:
            raise AssertionError(f"{' '.join(words)} ends with status {status}")
        return status == 0


@final
class AskStatus(OperatorCommand):
    """`evedrop status`."""

    kind, share = "ask for the status of", 1

    def _act(self, world: SimulatedWorld) -> int:
        self._type(world, "status")
        return 0


@final
class PauseRun(OperatorCommand):
    """`evedrop pause`, a step, and `evedrop resume` after some time, as often as needed."""

    kind, share = "pause", 3
    lasts, for_good, most_seconds = True, False, 100.0

    def _act(self, world: SimulatedWorld) -> int:
        self._type(world, "pause")
        until = here().monotonic() + (self.seconds or 0.0)
        while here().monotonic() < until and world.process(LAUNCHER) is not None:
            here().sleep(min(_AGAIN_SECONDS, until - here().monotonic()))
        self._type(world, "step", "1")
        while not self._type(world, "resume") and world.process(LAUNCHER) is not None:
            here().sleep(_AGAIN_SECONDS)
        return 0


class _Change(OperatorCommand):
    """The link of a receiver changes; the run's scenario has that as an event."""

    amends = True

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All links."""
        return scenario.receivers


@final
class ChangeLink(_Change):
    """`evedrop link NAME quality=…`."""

    kind, share = "change the link of", 2

    def _act(self, world: SimulatedWorld) -> int:
        self._type(world, "link", self.target, "quality=0.5")
        return 0


@final
class CutLink(_Change):
    """`evedrop link NAME cut`, and `heal` after some time."""

    kind, share = "cut the link of", 2
    lasts = True

    def _act(self, world: SimulatedWorld) -> int:
        self._type(world, "link", self.target, "cut")
        if self.seconds is not None:
            here().sleep(self.seconds)
            self._type(world, "link", self.target, "heal")
        return 0


@final
class LetStrangerIn(_Outsider):
    """A program that knows no password, or the operator's alone, reads and writes whatever it can at a router."""

    kind, share = "let a stranger into", 3
    program = "stranger"

    def _act(self, world: SimulatedWorld) -> int:
        try:
            controls = read_controls(world.results)
        except UsageError:  # the run has not begun, or is over
            return 0
        for control in controls:
            self._knock(replace(control, password=here().token(8).hex()))
            self._intrude(control, [*dict.fromkeys(process.task.name for process in world.machine.processes)])
        return 0

    @staticmethod
    def _knock(control: Control) -> None:
        try:
            here().zenoh.open(zenoh.Config.from_json5(json.dumps(client_config(control))))
        except zenoh.ZError:
            return
        raise AssertionError("a router lets in who does not know a password")

    @staticmethod
    def _intrude(control: Control, processes: Sequence[str]) -> None:
        """Read everything, slowly, put garbage on all keys, and ask what nobody understands."""
        keys = RunKeys(control.run)
        try:
            with here().zenoh.open(zenoh.Config.from_json5(json.dumps(client_config(control)))) as session:
                everything = session.declare_subscriber(
                    "**", here().zenoh.handlers.FifoChannel(1), allowed_origin=zenoh.Locality.REMOTE
                )
                of_processes = [name(process) for process in processes for name in (keys.control, keys.telemetry)]
                for key in (keys.uplink, keys.journal, keys.input, *of_processes):
                    session.put(key, here().token(1 + here().token(1)[0]))
                session.put(keys.uplink, bytes(_LARGEST_GARBAGE))
                asked = keys.control(RECORDER)
                answers = list(session.get(asked, payload=here().token(20)))
                refusals = list(session.get(asked, payload=enclosed(asked, pack({"do": "dance"}))))
                here().sleep(_LISTENS_SECONDS)
                read = everything.try_recv()
        except zenoh.ZError:  # the run is over
            return
        if read is not None or any(answer.ok is None for answer in answers):
            raise AssertionError(f"the operator reads {read or answers}")
        for refusal in refusals:
            payload = refusal.ok and payload_of(asked, refusal.ok.payload.to_bytes())
            if payload and not read_answer(asked, payload).refused:
                raise AssertionError("a recorder does what nobody understands")
