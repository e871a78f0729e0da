"""Raw Zenoh, the yardstick of live runs: the same messages through a router of Zenoh alone, from one sender to all receivers."""

from __future__ import annotations

from zenoh_peers import Load, Peer, Times, carry, session_of

from evedrop.system.ports import free_port

_KEY = "evedrop/raw/uplink"
BYTES_PER_TRIAL = 16
"""Of a packet of two states."""


def carried(load: Load, receivers: int) -> Times:
    """The times of all messages, sent by a process and received by others, with the router in this process."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with session_of("router", endpoint) as session:
        peers = [Peer(_KEY, f"evedrop/raw/alive/{i}") for i in range(receivers)]
        return carry(session, endpoint, Peer(_KEY, "evedrop/raw/alive/sensor"), peers, load)


def throughput(slots: int, trials: int, receivers: int) -> float:
    """Slots a second, as fast as it goes."""
    return carried(Load(slots, BYTES_PER_TRIAL * trials), receivers).slots_per_second
