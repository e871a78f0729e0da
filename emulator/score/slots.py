"""Truth, estimates and fates of the same slots, joined to be scored, recorded and shown, both live and in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Believed covariance of the recorded trials, (c, n, n, recorded)."""
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


@dataclass(frozen=True)
class InputSlots:
    """The controller's decisions over c slots."""

    u: Floats
    """As decided, (c, m, R); the plant may clip it."""
    failed: Flags
    """Whether the decision failed, so that the previous inputs are held, (c, R)."""


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

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    @property
    def trials(self) -> int:
        """Number of trials."""
        return int(self.x.shape[2])

    def copied(self) -> Slots:
        """A copy whose arrays for the view are its own: x, ν, sent, inputs, and the receivers' x̂, P and actions."""
        receivers = {
            name: replace(one, x_hat=one.x_hat.copy(), action=one.action.copy(), P=one.P.copy())
            for name, one in self.receivers.items()
        }
        sent = None if self.sent is None else self.sent.copy()
        inputs = None if self.inputs is None else InputSlots(self.inputs.u.copy(), self.inputs.failed.copy())
        return replace(self, x=self.x.copy(), nu=self.nu.copy(), receivers=receivers, sent=sent, inputs=inputs)


def concatenated(parts: Sequence[Slots]) -> Slots:
    """Consecutive slots as one, without alarms, true states, late and unsent packets and reasons for losses."""

    def column(name: str, one: str) -> NDArray[Any]:
        return np.concatenate([getattr(part.receivers[name], one) for part in parts])

    receivers = {
        name: ReceiverSlots(**{one: column(name, one) for one in _ARRAYS}, lost={}) for name in parts[0].receivers
    }
    x, nu = (np.concatenate([getattr(part, one) for part in parts]) for one in ("x", "nu"))
    sent = None if parts[0].sent is None else np.concatenate([all_set(part.sent, part.nu) for part in parts])
    inputs = None
    if parts[0].inputs is not None:
        of_parts = [part.inputs for part in parts if part.inputs is not None]
        inputs = InputSlots(*(np.concatenate([getattr(one, name) for one in of_parts]) for name in ("u", "failed")))
    return Slots(parts[0].first, x, nu, receivers, sent, inputs=inputs)


def all_set(flags: Flags | None, like: Flags) -> Flags:
    """The flags; if there are none, flags that are all set."""
    return np.ones_like(like) if flags is None else flags


_ARRAYS = ("x_hat", "action", "P", "trace", "delivered")
