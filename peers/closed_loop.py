"""The closed loop at sensor and legitimate estimator: their messages to the controller, and the inputs they get from it."""

from __future__ import annotations

from typing import final

from evedrop.live.network.process_session import InOrder, ReplayBuffer
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, EstimatorLoopPart, SensorLoopPart
from evedrop.live.protocol.telemetry import known, read_decided
from evedrop.model.plant import InputAwareEstimator
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Flags, Receiver


def kept_decisive(session: Session, key: str, brief: AnyBrief, period: int) -> ReplayBuffer:
    """A replay buffer for messages of decision slots: each may be needed until the next decision slot."""
    return session.replaying_publisher(key, brief.flow.window + 1 + period, back=period)


@final
class Decided:
    """Receives the controller's decisions, one in every `period` slots."""

    def __init__(self, session: Session, period: int, shape: tuple[int, int], patience: float) -> None:
        self._period, self._shape = period, shape
        key = session.keys.input
        self._messages = InOrder(session.subscribe(key), key, patience)
        self._now: tuple[Floats, Flags]

    def of(self, k: int) -> tuple[Floats, Flags]:
        """The inputs (m, R) of slot k, and where the decision failed, (R,); call it for slots in order."""
        if k % self._period == 0:
            self._now = read_decided(self._messages.take(k), k, self._shape)
        return self._now


@final
class Steered:
    """The closed loop at the sensor: waits for the inputs after every slot, and may send the true state.

    inputs: how many the controller decides.
    """

    def __init__(self, brief: AnyBrief, inputs: int, loop: SensorLoopPart, session: Session) -> None:
        self._period = loop.period
        self._decided = Decided(session, loop.period, (inputs, brief.trials), brief.flow.longest_outage)
        on_truth = loop.acts_on == "truth"
        self._put = kept_decisive(session, session.keys.state, brief, loop.period) if on_truth else None

    def decides(self, k: int) -> bool:
        """Whether the controller decides in slot k."""
        return k % self._period == 0

    def wait(self, k: int, x: Floats) -> tuple[Floats, Flags]:
        """The inputs (m, R) of slot k, whose true state is x (n, R), and where the decision failed, (R,)."""
        if self._put is not None and self.decides(k):
            self._put(k, known("x", k, x))
        return self._decided.of(k)


@final
class Consultation:
    """The closed loop at the legitimate estimator: sends its estimate, and may receive the inputs."""

    def __init__(self, brief: AnyBrief, loop: EstimatorLoopPart, session: Session, receiver: Receiver) -> None:
        self._period = loop.period
        self._put = (
            kept_decisive(session, session.keys.estimate, brief, self._period) if loop.acts_on == "estimate" else None
        )
        self._told: tuple[InputAwareEstimator, Decided] | None = None
        if isinstance(receiver, InputAwareEstimator) and loop.plant is not None:
            shape = (len(loop.plant.input_lower), brief.trials)
            self._told = receiver, Decided(session, self._period, shape, brief.flow.longest_outage)

    def before(self, k: int) -> None:
        """Receive the inputs that led into slot k, if the estimator knows the inputs."""
        if k > 0 and self._told is not None:
            receiver, inputs = self._told
            receiver.learn(k - 1, inputs.of(k - 1)[0])

    def after(self, k: int, belief: Belief) -> None:
        """Send the estimate of slot k, if the controller decides in it."""
        if self._put is not None and k % self._period == 0:
            self._put(k, known("x_hat", k, belief.x_hat))
