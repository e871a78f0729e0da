"""Faults of other hosts, and of the connections with them.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, final

from evedrop.live.launch.other_hosts import TOLERATED
from evedrop.virtual.disk import DiskFault
from evedrop.virtual.disturbance import ROUTERS, Disturbance
from evedrop.virtual.host_parts import CONNECTION, HOST_DISK, MACHINE, host_of

if TYPE_CHECKING:
    from evedrop.virtual.other_hosts import OtherHost
    from evedrop.virtual.run import SimulatedWorld


class HostDisturbance(Disturbance):
    """Something happens to a host."""

    part = CONNECTION
    """What it hits of the host."""

    def strike(self, world: SimulatedWorld) -> bool:
        """Do it."""
        if world.hosts is None:
            return False
        self.disturb(world, world.hosts[host_of(self.target)])
        return True

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """Do it to a host."""
        raise NotImplementedError


@final
class CutSsh(HostDisturbance):
    """The connection with a host is cut."""

    kind, share = "cut", 3
    harmless = False

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """Tell both ends that it is gone."""
        del world
        host.connection.cut()


@final
class FreezeSsh(HostDisturbance):
    """Nothing gets through the connection with a host for some time, though it seems open."""

    kind, share = "freeze", 3
    lasts = True

    def survived(self, longest_outage: float) -> bool:
        """Whether it is short enough for ssh."""
        return self.seconds is not None and self.seconds < TOLERATED * longest_outage

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """Let nothing through."""
        del world
        host.connection.freeze(self.seconds)


class _OfMachine(HostDisturbance):
    """Nobody can reach the processes of a host; who is not there cannot tell why."""

    part = MACHINE

    @property
    def blamed(self) -> tuple[str, ...]:
        """The host, and routers that may be there."""
        return (*super().blamed, *ROUTERS)


@final
class UnplugHost(_OfMachine):
    """A host is cut off from all others for some time."""

    kind, share = "unplug", 6
    lasts, cuts_off = True, True

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """Let nothing through."""
        host.connection.freeze(self.seconds)
        world.zenoh.unplug(host.name, self.seconds)


@final
class LosePower(_OfMachine):
    """A host loses its power: nobody is told."""

    kind, share = "take the power of", 4
    harmless = False

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """End everything there."""
        del world
        host.lose_power()


@final
class FillHostDisk(HostDisturbance):
    """The disk of a host is full, for some time or for good."""

    kind, share = "fill", 2
    lasts, lacking, harmless = True, True, False
    part = HOST_DISK

    def disturb(self, world: SimulatedWorld, host: OtherHost) -> None:
        """Fill it."""
        del world
        host.disk.fail_next(DiskFault.FULL, self.seconds)

    @property
    def blamed(self) -> tuple[str, ...]:
        """The host, or what was not written there."""
        return (*super().blamed, "cannot be written", "cannot be started", "temporary folder", "disk")


HOST_KINDS = {f"{kind.kind} {kind.part}": kind for kind in (CutSsh, FreezeSsh, UnplugHost, LosePower, FillHostDisk)}
