"""What sensor, link and receiver know of some slots: the columns that cores make, messages carry, and results hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Beliefs, Codes, Flags
from evedrop.model.record import Record, column

I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class SensorSlots(Record):
    """The sensor: the states, its schedule, its filter and watch, and the inputs that it got."""

    x: Floats = column("c n R", "states as they are sent")
    nu: Flags = column("c R", "whether the packet is an innovation, ν", "?")
    sent: Flags | None = column("c R", "whether a packet was sent; None: in every slot", "?", default=None)
    alarms: Flags | None = column(
        "c R", "whether the acknowledgements raised an alarm; None: nobody watches them", "?", default=None
    )
    u: Floats | None = column("c m R", "inputs as they were decided; None without a controller", default=None)
    failed: Flags | None = column("c R", "whether the decision failed, so that inputs stay", "?", default=None)
    true: Floats | None = column("c n R", "true states of a sensor that filters; None where they equal x", default=None)
    statistic: Floats | None = column("c R", "the detector's statistic after the slot; None without one", default=None)
    watermark: Floats | None = column("c m R", "what the watermark adds to the inputs, e", default=None)

    @property
    def states(self) -> Floats:
        """The true states, (c, n, R)."""
        return self.x if self.true is None else self.true

    @property
    def applied(self) -> Floats | None:
        """The inputs with the watermark, u + e, as the plant gets them before it clips them, (c, m, R)."""
        return self.u if self.u is None or self.watermark is None else self.u + self.watermark


@dataclass(frozen=True, eq=False)
class PacketSlots(Record):
    """The packets of some slots, as they reach the router."""

    z: Floats = column("c n R", "payloads; 0 where no packet was sent")
    header: I64 | None = column("c h R", "unencrypted headers; None for a scheme without", "<i8", default=None)
    sent: Flags | None = column("c R", "whether a packet was sent; None: in every slot", "?", default=None)
    truth: Floats | None = column("c n R", "the state itself, which is betrayed to one receiver", default=None)


@dataclass(frozen=True, eq=False)
class ReceiverSlots(Record):
    """A receiver: its estimates, what it did with the packets, and the covariances that it reports."""

    x_hat: Floats = column("c n R", "estimates")
    action: Codes = column("c R", "`Action`", "u1")
    P: Floats = column("c n n S", "reported covariances of the recorded trials")
    trace: Floats | None = column(
        "c 2", "sum over all trials of tr P, and of its square; None: not summed", default=None
    )
    late: U16 | None = column(
        "c R", "packets of earlier slots that arrived; None: the receiver accepts none", "<u2", default=None
    )
    late_used: U16 | None = column("c R", "those among them that it used", "<u2", default=None)

    @property
    def beliefs(self) -> Beliefs:
        """What the digests cover; with the covariances of the recorded trials only if not all are recorded."""
        return Beliefs(self.x_hat, self.P, self.action)

    @property
    def traces_of_trials(self) -> Floats | None:
        """Trace of P of every trial, (c, R); None unless all trials are recorded."""
        return kernels.traces(self.P) if self.P.shape[3] == self.action.shape[1] else None


@dataclass(frozen=True, eq=False)
class LinkSlots(Record):
    """A link according to the router: the fates of its packets."""

    delivered: Flags = column("c R", "whether the packet was delivered in its own slot", "?")
    lost: U32 = column("c F", "trials whose packet was lost, for each of `REASONS`", "<u4")
    unsent: U32 = column("c", "trials without a packet", "<u4")
    late: U16 | None = column(
        "c R", "packets of earlier slots delivered in this one, without second copies", "<u2", default=None
    )
