"""What is asked of a run in progress from outside: the operator's requests, by Zenoh queries to the recorder, and its health.

Whether a process is on the network now is asked of the router: only the router's view counts for other processes.

Source: docs/protocol.md, request and answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import zenoh
from msgspec import field

from evedrop.errors import MalformedMessage, UsageError
from evedrop.live.network.connecting import open_session
from evedrop.live.network.connection import Question
from evedrop.live.network.control_file import Control
from evedrop.live.network.endpoint import endpoint_in
from evedrop.live.network.session import client_config
from evedrop.live.protocol.brief import AnyBrief, RelayPart, RoutingPart
from evedrop.live.protocol.codec import Reader, StructMessage, enclosed, payload_of
from evedrop.live.protocol.keys import COMMAND_BYTES, QUESTION_BYTES, RunKeys
from evedrop.live.protocol.requests import OperatorRequest, RunStatus, WireStatus, read_request
from evedrop.names import OPERATOR, RECORDER
from evedrop.system.fields import Slot
from evedrop.system.world import world


class Answer(StructMessage, frozen=True, omit_defaults=True):
    """The answer to a request."""

    slot: Slot | None = field(default=None, name="k")
    """The slot from which on the request takes effect."""
    effect: str | None = None
    """The effect, as a sentence."""
    refused: tuple[str, ...] = ()
    """The mistakes in the request, a line each; then nothing has changed."""
    status: RunStatus | None = None
    """The status of the run, if the request was `status`."""
    wire: WireStatus | None = None
    """The status of the wire, if the request was `status`."""

    def __post_init__(self) -> None:
        if None in {self.slot, self.effect} and not (self.refused or self.status or self.wire):
            raise ValueError("it has neither k and effect nor refused, status or wire")


@final
@dataclass(frozen=True)
class Order:
    """A request with the Zenoh question that brought it, to be answered once."""

    request: OperatorRequest
    _question: Question

    @classmethod
    def of(cls, question: Question) -> Order | None:
        """The order in an operator's question; None if it is malformed, which is then refused."""
        try:
            return cls(read_request(OPERATOR, question.payload), question)
        except MalformedMessage as error:
            question.answer(Answer(refused=(str(error),)).pack())
            return None

    def answer(self, answer: Answer) -> None:
        """Send the answer; if it is too large to reach the operator, send only that it is."""
        payload = answer.pack()
        if len(payload) > COMMAND_BYTES:
            large = f"the answer has {len(payload)} bytes, and at most {COMMAND_BYTES} reach you; the summary has them later"
            payload = Answer(refused=(large,)).pack()
        self._question.answer(payload)

    def done(self, slot: int, text: str) -> None:
        """Answer that the request takes effect from this slot on; text: what was done, in words."""
        self.answer(Answer(slot, text))

    def refuse(self, *mistakes: str) -> None:
        """Answer that the request is refused, and that nothing was changed."""
        self.answer(Answer(refused=mistakes))


def read_answer(key: str, payload: bytes) -> Answer:
    """Decode an answer. Raises MalformedMessage if the message is not an answer."""
    return Reader(key, payload, parts=len(payload)).read(Answer)  # it has a map for each event so far


def ask(control: Control, request: OperatorRequest, patience: float) -> Answer | None:
    """Ask the recorder of a run; None if it does not answer within `patience` seconds, because the run is over or ends.

    Raises zenoh.ZError if the router is not there or refuses the operator, UsageError if the request cannot be sent.
    """
    try:
        payload = request.pack()
    except OverflowError as error:
        raise UsageError("the request has a whole number of more than 64 bits; expected smaller ones") from error
    if len(payload) > QUESTION_BYTES:
        raise UsageError(
            f"the request has {len(payload)} bytes; expected at most {QUESTION_BYTES}: give shorter values"
        )
    world().zenoh.init_log_from_env_or("off")
    key = RunKeys(control.run).control(RECORDER)
    # A run in progress has a router: one attempt is enough.
    with open_session(client_config(control)) as session:
        for reply in session.get(key, payload=enclosed(key, payload), timeout=patience):
            answer = None if reply.ok is None else payload_of(key, reply.ok.payload.to_bytes())
            if answer is not None:
                return read_answer(key, answer)
    return None


_CONNECT_SECONDS = 3.0
_ANSWER_SECONDS = 3.0


def is_there(brief: AnyBrief) -> bool:
    """Whether the router sees the process of a brief: connected, ready, and not lost since.

    Asks with the credentials of the process itself, which may ask for no other process.
    """
    world().zenoh.init_log_from_env_or("off")
    config = client_config(brief)
    config["connect"]["timeout_ms"] = int(_CONNECT_SECONDS * 1000)
    if isinstance(brief.part, RoutingPart):
        # The router asks itself. It may listen on every address, which its certificate does not name.
        listens = brief.part.listen if isinstance(brief.part, RelayPart) else brief.router
        config["connect"]["endpoints"] = [str(endpoint_in(listens).nearby)]
        config["transport"]["link"].get("tls", {})["verify_name_on_connect"] = False
    try:
        with open_session(config) as session:
            answers = session.liveliness().get(RunKeys(brief.run).alive(brief.process), timeout=_ANSWER_SECONDS)
            return any(answer.ok is not None for answer in answers)
    except zenoh.ZError:
        return False
