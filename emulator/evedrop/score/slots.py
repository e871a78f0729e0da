"""Truth, estimates and fates of the same slots, joined to be scored, recorded and shown, both live and in memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags


@dataclass(frozen=True)
class ReceiverSlots:
    """One receiver over c slots."""

    x_hat: Floats
    """Estimates, (c, n, R)."""
    action: Codes
    """`Action`, (c, R)."""
    P: Floats
    """Reported covariance of the recorded trials, (c, n, n, recorded)."""
    trace: Floats
    """Sum over all trials of tr P and of its square, (c, 2)."""
    delivered: Flags
    """Whether the router reports the packet as delivered, (c, R)."""
    lost: Mapping[str, NDArray[np.uint32]]
    """Reason → packets that the router reports as lost for it, (c,)."""
    late: NDArray[np.uint16] | None = None
    """Counts of packets of earlier slots that arrived in each slot, (c, R); None if the receiver accepts no late packets."""
    late_used: NDArray[np.uint16] | None = None
    """Counts of the late packets that it used, (c, R)."""
    late_delivered: NDArray[np.uint16] | None = None
    """Counts of the late packets that were delivered according to the router, (c, R)."""
    unsent: NDArray[np.uint32] | None = None
    """Counts of the trials without a packet according to the router, (c,); None: every trial had one."""

    @property
    def traces_of_trials(self) -> Floats | None:
        """Trace of P of every trial, (c, R); None unless all trials are recorded."""
        return kernels.traces(self.P) if self.P.shape[3] == self.action.shape[1] else None

    def part(self, trials: slice) -> ReceiverSlots:
        """The same for some of the trials; counts over all trials stay as they are."""
        late, used, delivered = (
            None if column is None else column[:, trials] for column in (self.late, self.late_used, self.late_delivered)
        )
        return replace(
            self,
            x_hat=self.x_hat[..., trials],
            action=self.action[:, trials],
            P=self.P[..., trials],
            delivered=self.delivered[:, trials],
            late=late,
            late_used=used,
            late_delivered=delivered,
        )


@dataclass(frozen=True)
class InputSlots:
    """The controller's decisions over c slots."""

    u: Floats
    """As decided, (c, m, R); the plant may clip it."""
    failed: Flags
    """Whether the decision failed, so that the previous inputs are held, (c, R)."""
    monitored: MonitoredSlots | None = None
    """The watermark, and what the detector for the sensor's filter says; None without one."""

    def part(self, trials: slice) -> InputSlots:
        """The same for some of the trials."""
        monitored = None if self.monitored is None else self.monitored.part(trials)
        return InputSlots(self.u[..., trials], self.failed[:, trials], monitored)


@dataclass(frozen=True)
class Slots:
    """c consecutive slots of all trials, complete."""

    first: int
    x: Floats
    """States as the sensor sends them, (c, n, R)."""
    nu: Flags
    """ν, (c, R)."""
    receivers: Mapping[str, ReceiverSlots]
    sent: Flags | None = None
    """Whether the sensor sent a packet, (c, R); None: always."""
    alarms: Flags | None = None
    """As in `Truth`."""
    inputs: InputSlots | None = None
    """None without a controller."""
    true: Floats | None = None
    """The true states, (c, n, R), for a sensor that filters; None where they equal x."""

    @classmethod
    def example(cls, receivers: Iterable[str]) -> Slots:
        """Slots without numbers, with an instance of every class that slots may have."""
        nothing: Any = np.zeros(0)
        of_receiver = ReceiverSlots(nothing, nothing, nothing, nothing, nothing, {})
        inputs = InputSlots(nothing, nothing, MonitoredSlots(nothing, nothing))
        return cls(0, nothing, nothing, dict.fromkeys(receivers, of_receiver), inputs=inputs)

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    @property
    def trials(self) -> int:
        """Number of trials."""
        return int(self.x.shape[2])

    def part(self, trials: slice) -> Slots:
        """The same for some of the trials; counts over all trials stay as they are."""
        sent, alarms = (None if part is None else part[:, trials] for part in (self.sent, self.alarms))
        return replace(
            self,
            x=self.x[..., trials],
            nu=self.nu[:, trials],
            receivers={name: part.part(trials) for name, part in self.receivers.items()},
            sent=sent,
            alarms=alarms,
            inputs=None if self.inputs is None else self.inputs.part(trials),
            true=None if self.true is None else self.true[..., trials],
        )

    def copied(self) -> Slots:
        """A copy whose arrays are its own, so that it does not keep larger ones in memory."""
        copy: Slots = _copied(self)
        return copy


def _copied(value: Any) -> Any:
    """An entry whose arrays are its own: tables and classes entry by entry."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, Mapping):
        return {name: _copied(entry) for name, entry in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{entry.name: _copied(getattr(value, entry.name)) for entry in fields(value)})
    return value


def concatenated(parts: Sequence[Slots]) -> Slots:
    """Consecutive slots as one. Raises ValueError if only some of the parts have an entry."""
    whole: Slots = _joined(parts)
    return whole


def _joined(values: Sequence[Any]) -> Any:
    """The values of one entry in consecutive slots as one: arrays along the slots, tables and classes entry by entry."""
    kinds = {type(item) for item in values}
    if len(kinds) > 1:
        raise ValueError(f"some of the parts have an entry that others lack: {sorted(kind.__name__ for kind in kinds)}")
    first = values[0]
    if first is None or isinstance(first, int):  # the number of the first slot
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(values)
    if isinstance(first, Mapping):
        names = dict.fromkeys(name for item in values for name in item)
        return {name: _joined([item.get(name) for item in values]) for name in names}
    return type(first)(
        **{item.name: _joined([getattr(value, item.name) for value in values]) for item in fields(first)}
    )


def all_set(flags: Flags | None, like: Flags) -> Flags:
    """The flags; if there are none, flags that are all set."""
    return np.ones_like(like) if flags is None else flags
